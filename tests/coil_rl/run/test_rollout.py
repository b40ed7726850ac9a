import pytest
import torch
import worlds
from tensordict import TensorDict
from torchrl.envs import CatFrames, Compose, RewardSum, TransformedEnv
from torchrl.modules import RandomPolicy

from coil_rl import GymnasiumEnv
from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.errors import UserError
from coil_rl.guides import RandomGuide, SplineGuide
from coil_rl.learners import PPO
from coil_rl.run.rollout import Rollout, check_batch
from coil_rl.transforms import GuideActions


def rollout(seed=0, steps=6, keys=None):
    env = ConeTrackEnv(shipped_tracks("train"), 5, seed=seed, rate=8)
    past = CatFrames(N=3, dim=-1, in_keys=["observation"], out_keys=["past"])
    env = TransformedEnv(env, Compose(GuideActions({"spline": SplineGuide()}), RewardSum(), past))
    return Rollout(env, RandomGuide(-1, 0.2, seed=seed), steps, keys)


@pytest.mark.slow
def test_batches_are_consecutive():
    long, short = rollout(steps=60), rollout(steps=20)
    parts = torch.cat([short.collect() for _ in range(3)], 1)
    whole = long.collect()
    assert whole["next", "done"].any()
    assert (whole == parts).all()
    assert whole.batch_size == (5, 60)
    assert long.frames == 300


def test_only_the_requested_keys_are_kept():
    keys = {"observation", ("next", "reward"), ("next", "info", "lap")}
    batch = rollout(keys=[*keys, *keys]).collect()
    assert set(batch.keys(True, True)) == keys
    whole = rollout().collect()
    assert all(torch.equal(batch[key], whole[key]) for key in keys)


def test_restored_rollout_gives_the_same_batches():
    first, second = rollout(seed=1), rollout(seed=2)
    first.collect()
    second.load_state_dict(first.state_dict())
    second.policy.load_state_dict(first.policy.state_dict())
    batches = [(first.collect(), second.collect()) for _ in range(10)]
    assert all((one == other).all() for one, other in batches)
    assert any(one["next", "done"].any() for one, _ in batches)


def learning(env, correlation, squash=True, observed="observation"):
    ppo = PPO(env, [observed], squash=squash)
    keys = [*ppo.keys, "loc", "scale", "action"]
    return ppo, Rollout(env, ppo.policy, 50, keys, noise_correlation=correlation)


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.8])
@pytest.mark.parametrize("squash", [True, False])
def test_noise_is_correlated_over_steps_and_batches_and_each_action_has_the_policys_distribution(
    correlation, squash
):
    torch.manual_seed(0)
    ppo, rollout = learning(worlds.cones(cars=150), correlation, squash)
    batch = torch.cat([rollout.collect(), rollout.collect()], 1)
    assert batch["next", "done"].any()
    sample = batch["action"].atanh() if squash else batch["unclipped_action"]
    noise = ((sample - batch["loc"]) / batch["scale"]).squeeze(-1)
    assert float(noise.mean()) == pytest.approx(0.0, abs=0.05)
    assert float(noise.std()) == pytest.approx(1.0, abs=0.04)
    for lag in (1, 2, 5):
        found = float((noise[:, lag:] * noise[:, :-lag]).mean())
        assert found == pytest.approx(correlation**lag, abs=0.06)
    assert float((noise[:, 50] * noise[:, 49]).mean()) == pytest.approx(correlation, abs=0.25)
    with torch.no_grad():
        drawn = batch["action" if squash else "unclipped_action"]
        density = ppo.policy.get_dist(batch).log_prob(drawn)
    torch.testing.assert_close(batch["action_log_prob"], density)


@pytest.mark.slow
def test_correlated_noise_goes_on_after_a_restored_state():
    env, other = worlds.cones(), worlds.cones()
    (ppo, first), (_, second) = learning(env, 0.9), learning(other, 0.9)
    second.policy.load_state_dict(ppo.policy.state_dict())
    first.collect()
    second.load_state_dict(first.state_dict())
    batches = []
    for rollout in (first, second):
        torch.manual_seed(1)
        batches.append(rollout.collect())
    assert (batches[0] == batches[1]).all()


def test_noise_fits_envs_without_a_batch_and_does_not_concern_discrete_actions():
    torch.manual_seed(0)
    _, rollout = learning(worlds.pendulum(), 1.0, observed="th")
    batch = rollout.collect()
    noise = ((batch["action"] / 2).atanh() - batch["loc"]) / batch["scale"]
    torch.testing.assert_close(noise, noise[:1].expand_as(noise), rtol=0, atol=1e-4)
    env = worlds.carts()
    discrete = Rollout(env, PPO(env).policy, 3, noise_correlation=0.9)
    assert "exploration_noise" not in discrete.collect()


POSE = ("next", "info", "pose")


def zeros():
    after = {"observation": torch.zeros(4, 6, 3), "info": {"pose": torch.zeros(4, 6, 2)}}
    count = torch.zeros(4, 6, 1, dtype=torch.int64)
    return TensorDict({"observation": torch.zeros(4, 6, 3), "count": count, "next": after}, [4, 6])


@pytest.mark.parametrize(
    ("places", "message"),
    [
        ([("observation", 3, 2, 1)], "observation is nan at step 103 of row 3"),
        ([(POSE, 2, 5, 0), ("observation", 2, 5, 0)], "observation is nan at step 106 of row 2"),
        ([(POSE, 0, 1, 0), ("observation", 3, 4, 0)], "next/info/pose is nan at step 102 of row 0"),
    ],
)
def test_first_nan_is_reported_with_its_entry_step_and_row(places, message):
    batch = zeros()
    for key, car, t, number in places:
        batch[key][car, t, number] = torch.nan
    with pytest.raises(UserError, match=f"^{message}$"):
        check_batch(batch, steps=100)


@pytest.mark.parametrize("lean", [True, False])
def test_nan_of_a_policy_is_named_where_its_action_breaks_the_step(lean):
    env = GymnasiumEnv("MountainCarContinuous-v0", 2)  # refuses such an action
    policy, calls = PPO(env).policy, iter(range(9))

    def break_action(module, inputs, outputs):
        outputs[0][1] += torch.nan if next(calls) == 6 else 0.0

    policy.module[-2].module.register_forward_hook(break_action)
    collected = Rollout(env, policy, 4, policy.in_keys if lean else None)
    assert (collected.lean is not None) == lean
    collected.collect()
    with pytest.raises(UserError, match=r"^loc is nan at step 7 of row 1$"):
        collected.collect()


def test_number_of_info_without_a_value_is_no_fault():
    env = GymnasiumEnv("CartPole-v1", 2, info=["lap"])
    collected = Rollout(env, RandomPolicy(env.action_spec), 5)
    with pytest.warns(UserWarning, match="had no lap in the info"):
        batches = [collected.collect() for _ in range(20)]
    assert all(batch["next", "info", "lap"].isnan().all() for batch in batches)


def test_infinity_is_reported_also_without_a_batch_dimension():
    batch = zeros()[0]
    check_batch(batch)
    batch["next", "observation"][4, 0] = -torch.inf
    with pytest.raises(UserError, match="next/observation is -inf at step 5 of row 0"):
        check_batch(batch)
