import importlib
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from coil_rl.envs import ConeTrackEnv, Track, gym, shipped_tracks
from coil_rl.guides import ConstantGuide, SplineGuide


def test_gymnasium_check_env_passes():
    env = gymnasium.make(gym.ID)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    assert env.observation_space == gymnasium.spaces.Box(-1, 1, (20,), np.float32)


def test_stable_baselines3_checks_and_trains_the_env():
    checker = pytest.importorskip(
        "stable_baselines3.common.env_checker", reason="stable-baselines3 is not installed"
    )
    env = gymnasium.make(gym.ID, advice=SplineGuide())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(env.unwrapped)
    sb3 = importlib.import_module("stable_baselines3")
    model = sb3.PPO("MlpPolicy", env, n_steps=64, batch_size=32, n_epochs=1, seed=0, device="cpu")
    assert model.learn(64).num_timesteps == 64


def episode(env, seed, steps=40):
    observation, info = env.reset(seed=seed)
    rng = np.random.default_rng(0)
    rows = [observation]
    for _ in range(steps):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        observation, reward, *_ = env.step(action)
        rows += [observation, reward]
    return info["track"], rows


@pytest.mark.fast(1)
@pytest.mark.parametrize("cars", [None, 3])
def test_seed_determines_tracks_and_episodes(cars):
    env = gymnasium.make(gym.ID) if cars is None else gymnasium.make_vec(gym.ID, num_envs=cars)
    track, rows = episode(env, 3)
    again, same = episode(env, 3)
    np.testing.assert_array_equal(track, again)
    for one, other in zip(rows, same, strict=True):
        np.testing.assert_array_equal(one, other)
    assert len({np.asarray(episode(env, seed, 0)[0]).tobytes() for seed in range(8)}) > 1


def test_seed_among_the_options_determines_the_first_tracks_and_without_they_differ():
    def drawn(**options):
        return gymnasium.make_vec(gym.ID, num_envs=32, **options).reset()[1]["track"].tolist()

    assert drawn() != drawn()
    assert drawn(seed=3) == drawn(seed=3)


@pytest.mark.slow
def test_vector_env_agrees_with_the_batched_env():
    cars = 6
    envs, guide = gymnasium.make_vec(gym.ID, num_envs=cars, advice=SplineGuide()), SplineGuide()
    assert envs.single_observation_space.shape == (21,)
    ours = ConeTrackEnv(shipped_tracks("train"), cars, seed=5)
    observation, _ = envs.reset(seed=5)
    state = ours.reset()
    np.testing.assert_array_equal(observation[:, :20], state["observation"])
    generator = torch.Generator().manual_seed(0)
    for _ in range(120):
        action = torch.rand(cars, 1, generator=generator) * 2 - 1
        step, state = ours.step_and_maybe_reset(state.set("action", action))
        observation, reward, terminated, truncated, info = envs.step(action.numpy())
        np.testing.assert_array_equal(observation[:, :20], state["observation"])
        np.testing.assert_array_equal(observation[:, 20:], guide(state.copy())["action"])
        found = {"reward": reward, "terminated": terminated, "truncated": truncated}
        for key, array in found.items():
            np.testing.assert_array_equal(array, step["next", key].squeeze(-1))
        np.testing.assert_array_equal(info["track"], state["info", "track"].squeeze(-1))
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP


@pytest.mark.parametrize("advice", [None, ConstantGuide(0.25)])
def test_autoreset_returns_the_final_and_the_next_observation(advice):
    envs = gymnasium.make_vec(gym.ID, num_envs=16, advice=advice)
    envs.reset(seed=0)
    done = np.array(False)
    while not done.any():
        observation, reward, done, _, info = envs.step(envs.action_space.sample())
    assert done.tolist() == info["_final_obs"].tolist() == info["_final_info"].tolist()
    assert not done.all()
    assert [last is not None for last in info["final_obs"]] == done.tolist()
    last = np.stack(info["final_obs"][done])
    assert last.shape == (done.sum(), 20 + (advice is not None))
    cars = envs.unwrapped.env
    start = cars.start_observation[:, cars.track].t().numpy()
    np.testing.assert_array_equal(observation[done, :20], start[done])
    assert (last[:, :20] != start[done]).any()
    assert info["final_info"]["crashed"][done].all()
    assert (reward[done] == -100).all()
    assert not info["crashed"][done].any()
    if advice is not None:
        assert (observation[:, 20] == 0.25).all()
        assert (last[:, 20] == 0.25).all()


def test_time_limit_truncates_and_crash_terminates(ring: Track):
    env = gymnasium.make(gym.ID, tracks=[ring], time_limit=0.25, rate=8)
    env.reset(seed=0)
    straight = np.zeros(1, np.float32)
    assert env.step(straight)[2:4] == (False, False)
    assert env.step(straight)[2:4] == (False, True)
    env = gymnasium.make(gym.ID, tracks=[ring])
    env.reset(seed=0)
    while not (step := env.step(straight))[2]:
        pass
    _, reward, _, truncated, info = step
    assert (reward, info["reward"]["crash"]) == (-100, -100)
    assert (truncated, info["crashed"]) == (False, True)


def test_returned_arrays_are_copies_and_info_is_optional():
    assert gymnasium.make_vec(gym.ID, num_envs=4, info=False).reset(seed=0)[1] == {}
    envs = gymnasium.make_vec(gym.ID, num_envs=4)
    observation, info = envs.reset(seed=0)
    observation[:], info["pose"][:] = 7, 7
    assert not (envs.unwrapped.env.pose == 7).any()
    again, _ = envs.reset(seed=0)
    assert not (again == 7).any()


def test_reset_of_some_cars_obeys_its_seed_and_leaves_the_others():
    mask, starts, straight = np.array([False, True] * 4), [], np.zeros((8, 1), np.float32)
    for steps in (1, 7):
        envs = gymnasium.make_vec(gym.ID, num_envs=8)
        envs.reset(seed=steps)
        for _ in range(steps):
            before = envs.step(straight)[0]
        observation, _ = envs.reset(seed=11, options={"reset_mask": mask})
        np.testing.assert_array_equal(observation[~mask], before[~mask])
        starts.append([observation[mask], envs.step(straight)[0][mask]])
    np.testing.assert_array_equal(*starts)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": [1, 2, 3, 4]}, r"seed=\[1, 2, 3, 4\] must be one whole number"),
        ({"seed": "1"}, "seed='1' must be one whole number"),
        ({"options": {"reset_mask": np.zeros(4, bool)}}, "reset_mask must be 4 flags, .* at least"),
        ({"options": {"reset_mask": np.ones(3, bool)}}, "reset_mask must be 4 flags"),
        ({"options": {"reset_mask": [1, 0, 0, 1]}}, "reset_mask must be 4 flags"),
        ({"options": {"mask": [True] * 4}}, "options has mask, but can only hold reset_mask"),
    ],
)
def test_reset_that_cannot_be_is_refused(arguments, message):
    envs = gymnasium.make_vec(gym.ID, num_envs=4)
    with pytest.raises(ValueError, match=message):
        envs.reset(**arguments)
