import torch
from torchrl.envs import Compose, RewardSum, TransformedEnv

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import RandomGuide, SplineGuide
from coil_rl.train.rollout import Rollout
from coil_rl.transforms import GuideActions


def rollout(seed=0, steps=6, keys=None):
    env = ConeTrackEnv(shipped_tracks("train"), 5, seed=seed, rate=8)
    env = TransformedEnv(env, Compose(GuideActions({"spline": SplineGuide()}), RewardSum()))
    return Rollout(env, RandomGuide(-1, 0.2, seed=seed), steps, keys)


def test_batches_follow_one_another():
    long, short = rollout(steps=60), rollout(steps=20)
    parts = torch.cat([short.collect() for _ in range(3)], 1)
    whole = long.collect()
    assert whole["next", "done"].any()
    assert (whole == parts).all()
    assert whole.batch_size == (5, 60)
    assert long.frames == 300


def test_next_of_a_step_is_the_step_after_it_unless_the_episode_ended():
    batch = rollout(steps=60).collect()
    after, now = batch["next", "observation"][:, :-1], batch["observation"][:, 1:]
    going_on = ~batch["next", "done"][:, :-1].squeeze(-1)
    assert torch.equal(after[going_on], now[going_on])
    assert not torch.equal(after[~going_on], now[~going_on])


def test_only_the_keys_asked_for_are_kept():
    keys = {"observation", ("next", "reward"), ("next", "info", "lap")}
    batch = rollout(keys=[*keys, *keys]).collect()
    assert set(batch.keys(True, True)) == keys
    whole = rollout().collect()
    assert all(torch.equal(batch[key], whole[key]) for key in keys)


def test_state_dict_goes_on_in_another_rollout():
    first, second = rollout(seed=1), rollout(seed=2)
    first.collect()
    second.load_state_dict(first.state_dict())
    second.policy.load_state_dict(first.policy.state_dict())
    batches = [(first.collect(), second.collect()) for _ in range(10)]
    assert all((one == other).all() for one, other in batches)
    assert any(one["next", "done"].any() for one, _ in batches)
