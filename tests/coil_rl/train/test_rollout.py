import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, RewardSum, TransformedEnv

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.errors import UserError
from coil_rl.guides import RandomGuide, SplineGuide
from coil_rl.train.rollout import Rollout, check_batch
from coil_rl.transforms import GuideActions


def rollout(seed=0, steps=6, keys=None):
    env = ConeTrackEnv(shipped_tracks("train"), 5, seed=seed, rate=8)
    env = TransformedEnv(env, Compose(GuideActions({"spline": SplineGuide()}), RewardSum()))
    return Rollout(env, RandomGuide(-1, 0.2, seed=seed), steps, keys)


def test_batches_are_consecutive():
    long, short = rollout(steps=60), rollout(steps=20)
    parts = torch.cat([short.collect() for _ in range(3)], 1)
    whole = long.collect()
    assert whole["next", "done"].any()
    assert (whole == parts).all()
    assert whole.batch_size == (5, 60)
    assert long.frames == 300


def test_next_entry_is_the_following_step_unless_the_episode_ended():
    batch = rollout(steps=60).collect()
    after, now = batch["next", "observation"][:, :-1], batch["observation"][:, 1:]
    running = ~batch["next", "done"][:, :-1].squeeze(-1)
    assert torch.equal(after[running], now[running])
    assert not torch.equal(after[~running], now[~running])


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


def zeros():
    after = {"observation": torch.zeros(4, 6, 3), "info": {"pose": torch.zeros(4, 6, 2)}}
    count = torch.zeros(4, 6, 1, dtype=torch.int64)
    return TensorDict({"observation": torch.zeros(4, 6, 3), "count": count, "next": after}, [4, 6])


@pytest.mark.parametrize(
    ("places", "message"),
    [
        ([("observation", 3, 2, 1)], "observation is nan at step 103 of row 3"),
        ([(("next", "info", "pose"), 2, 5, 0), ("observation", 2, 5, 0)], "observation is nan at step 106 of row 2"),
        ([(("next", "info", "pose"), 0, 1, 0), ("observation", 3, 4, 0)], "next/info/pose is nan at step 102 of row 0"),
    ],
)
def test_first_nan_is_reported_with_its_entry_step_and_row(places, message):
    batch = zeros()
    for key, car, t, number in places:
        batch[key][car, t, number] = torch.nan
    with pytest.raises(UserError, match=f"^{message}$"):
        check_batch(batch, steps=100)


def test_infinity_is_reported_also_without_a_batch_dimension():
    batch = zeros()[0]
    check_batch(batch)
    batch["next", "observation"][4, 0] = -torch.inf
    with pytest.raises(UserError, match="next/observation is -inf at step 5 of row 0"):
        check_batch(batch)
