import gc
import os
from pathlib import Path

import fmus
import numpy as np
import pytest
import torch

from coil_fmu import FMU, fmu_env
from coil_rl import check_env

FOLLOW = {"step": 0.01, "seconds": 0.2, "setpoints": {"speed": 100.0}}
DRAWN = {
    **FOLLOW,
    "setpoints": {"speed": {"low": 50, "high": 150, "every": 0.05}},
    "parameters": {"inertia": {"low": 0.008, "high": 0.012}},
}


def motor(**settings):
    return fmu_env(fmus.motor(), **{**FOLLOW, **settings})


def tank(**settings):
    wanted = {"step": 0.5, "seconds": 10.0, "setpoints": {"level": 0.8}}
    return fmu_env(fmus.tank(), **{**wanted, **settings})


def driven(env, steps, action=None):
    torch.manual_seed(0)
    present, taken = env.reset(), []
    for _ in range(steps):
        if action is None:
            present = env.rand_action(present)
        else:
            present["action"] = torch.full_like(env.action_spec.zero(), action)
        taken.append(env.step(present))
        present = env.step_mdp(taken[-1])
    return torch.stack(taken, 1)


def test_env_has_the_contract_of_an_env():
    check_env(motor(num_envs=3, **DRAWN))
    check_env(tank(num_envs=2))


def test_description_gives_bounds_units_and_rate():
    env = motor()
    assert env.action_spec.space.high.item() == 24.0
    assert env.rate == 100.0
    assert env.meanings == {
        "speed": {"unit": "rad/s", "meaning": "nominal 100"},
        "current": {"unit": "A", "meaning": "current"},
        "speed_setpoint": {"unit": "rad/s", "meaning": "what speed is to be in the next step"},
        "action": {"unit": "V", "meaning": "voltage (of the armature)"},
    }
    low, high = tank().observation_bounds["level"]
    assert (low.item(), high.item()) == (0.0, 2.0)


def test_step_has_the_solver_steps_that_the_fmu_prefers():
    fine = driven(motor(step=0.01), 20, 12.0)["next", "speed"][0, -1]
    coarse = driven(motor(step=0.1), 2, 12.0)["next", "speed"][0, -1]
    one = driven(motor(step=0.1, substeps=1), 2, 12.0)["next", "speed"][0, -1]
    assert torch.equal(fine, coarse)
    assert not torch.equal(fine, one)


def test_reward_is_the_error_and_the_prices():
    from coil_fmu import Follow

    env = motor(reward=Follow("squared", {"speed": 2.0}, action=0.1, change=0.5))
    data = driven(env, 2, 3.0)
    speed = data["next", "speed"][0, :, 0].double()
    wanted = -2 * (100 - speed) ** 2 - 0.1 * 9
    wanted[0] -= 0.5 * 9
    torch.testing.assert_close(data["next", "reward"][0, :, 0].double(), wanted, rtol=1e-6, atol=0)


def only_speed(now, before):
    return now.outputs["speed"][0] - before.outputs["speed"][0], now.time > 0.045


@pytest.mark.parametrize("given", [only_speed, f"{__name__}:only_speed"])
def test_reward_and_end_are_a_function_of_a_user(given, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, __name__, sys.modules[only_speed.__module__])
    data = driven(motor(reward=given, setpoints={}), 5, 10.0)
    torch.testing.assert_close(data["next", "reward"].sum(), data["next", "speed"][0, -1, 0])
    assert data["next", "terminated"][0, :, 0].tolist() == [False] * 4 + [True]


def test_seed_draws_parameters_and_setpoints():
    env, other = (motor(num_envs=3, seed=seed, **DRAWN) for seed in (0, 1))
    first, again = (driven(env, 12) for _ in range(2))
    assert first["info", "inertia"][:, 0].unique().numel() == 3
    assert first["speed_setpoint"].unique().numel() > 3
    assert not torch.equal(first["info", "inertia"], again["info", "inertia"])
    assert not torch.equal(first["info", "inertia"], driven(other, 12)["info", "inertia"])
    fixed = motor(num_envs=3, first_seed=5, **DRAWN)
    assert torch.equal(driven(fixed, 12)["next", "speed"], driven(fixed, 12)["next", "speed"])


def test_a_course_may_be_ramps_or_a_column_of_a_file(tmp_path):
    file = tmp_path / "courses.csv"
    file.write_text("time,slow,fast\n0,10,100\n0.05,20,200\n")
    held = driven(motor(setpoints={"speed": {"file": str(file)}}), 8)["speed_setpoint"][0, :, 0]
    assert held.tolist() in ([10.0] * 5 + [20.0] * 3, [100.0] * 5 + [200.0] * 3)
    ramp = motor(setpoints={"speed": {"file": str(file), "kind": "ramps"}})
    rising = driven(ramp, 8)["speed_setpoint"][0, :, 0]
    np.testing.assert_allclose(rising[:6] / rising[0], [1, 1.2, 1.4, 1.6, 1.8, 2.0], rtol=1e-5)


def rising(now, before):
    rate = (now.outputs["level"] - before.outputs["level"]) / (now.time - before.time)
    return np.float32(-rate.item())


@pytest.mark.parametrize("settings", [{}, {"reward": rising, "setpoints": {}}])
def test_failure_ends_the_episode_and_is_said_and_counted(settings):
    env = tank(**settings)
    with pytest.warns(UserWarning, match=r"tank.fmu failed after \S+ s .*overflows"):
        data = driven(env, 20, 0.5)["next"]
    ends = int(data["done"][0, :, 0].nonzero()[0])
    assert data["terminated"][0, ends]
    assert not data["truncated"].any()
    assert data["info", "failed"][0, :, 0].tolist()[: ends + 1] == [0.0] * ends + [1.0]
    assert torch.isfinite(data["level"]).all()
    # Each step that is left counts as the worst one: to fail early is never worth it.
    worst = data["reward"][0, :ends].min().item()
    assert data["reward"][0, ends].item() == pytest.approx((20 - ends) * worst, rel=1e-5)
    assert worst < 0
    assert driven(tank(**settings, failure=-7.0), 20, 0.5)["next", "reward"][0, ends].item() == -7.0


def test_env_goes_on_after_a_failure():
    env = tank()
    before = driven(env, 10, 0.05)["next", "level"]
    driven(env, 20, 0.5)
    assert torch.equal(driven(env, 10, 0.05)["next", "level"], before)


def test_restored_env_goes_on_to_the_bit():
    env, other = (motor(num_envs=2, **DRAWN) for _ in range(2))
    data = env.reset()
    for _ in range(7):
        data = env.step_mdp(env.step(env.rand_action(data)))
    other.load_state_dict(env.state_dict())
    assert other.continues
    action = env.rand_action(data)
    here, there = env.step(action.clone())["next"], other.step(action.clone())["next"]
    for key in ("speed", "speed_setpoint", "reward"):
        assert torch.equal(here[key], there[key])


def test_workers_have_the_same_digits():
    here, spread = (motor(num_envs=4, workers=n, **DRAWN) for n in (0, 2))
    assert torch.equal(driven(here, 15)["next", "speed"], driven(spread, 15)["next", "speed"])
    spread.close()


def test_rows_are_instances_of_their_own():
    data = driven(motor(num_envs=2), 5)
    assert not torch.equal(data["next", "speed"][0], data["next", "speed"][1])


def open_files():
    return len(os.listdir("/proc/self/fd")) + Path("/proc/self/maps").read_text().count(".so")


def megabytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE") / 1e6


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="it counts handles as Linux does")
def test_a_thousand_episodes_leave_no_handle_and_no_memory():
    env = tank(seconds=0.5)
    driven(env, 10)
    for _ in range(100):
        env.reset()
    before, used = open_files(), megabytes()
    for _ in range(1_000):
        env.reset()
    assert megabytes() - used < 10
    for _ in range(20):
        driven(tank(num_envs=2, fresh=True), 3, 0.5).clear()
        gc.collect()
    assert open_files() - before < 5


def test_unpacked_folders_are_removed():
    env = motor()
    place = env.held.plants[0].env.unwrapped.model.folder
    assert Path(place, "modelDescription.xml").exists()
    env.close()
    del env
    gc.collect()
    assert not Path(place).exists()


def test_gymnasium_sees_an_ordinary_env():
    from gymnasium.utils.env_checker import check_env as check

    env = motor().held.plants[0].env
    assert isinstance(env, FMU)
    check(env, skip_render_check=True)
