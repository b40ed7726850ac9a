import pytest
import torch
from torchrl.envs import Compose, TransformedEnv
from worlds import acting

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.transforms import (
    BiasedAdvice,
    DiscreteActions,
    GuideActions,
    RemovedAdvice,
    ResidualAction,
    RewardCoupling,
    Takeover,
)


def advised(advice, *transforms, choices=5):
    """One car for each number, with that number as constant advice."""
    env = ConeTrackEnv(shipped_tracks("test")[:1], len(advice), rate=6)
    guide = acting(lambda _: torch.tensor(advice).unsqueeze(-1), "steering")
    env = TransformedEnv(
        env, Compose(GuideActions({"constant": guide}), *transforms, DiscreteActions(choices))
    )
    return env.train()


def step(env, *choices):
    return env.step(env.reset().set("action", torch.tensor(choices)))


def close(tensor, numbers):
    return tensor.flatten().tolist() == pytest.approx(numbers)


def test_advice_is_one_hot_at_the_nearest_choice_and_kept_as_a_number():
    advice = [-0.9, -0.7, -0.25, 0.2, 0.26, 1.0]
    env = advised(advice)
    for data in (env.reset(), step(env, *[2] * 6)["next"]):
        assert torch.equal(data["guide_action"], torch.eye(5)[[0, 1, 1, 2, 3, 4]].unsqueeze(1))
        assert close(data["guide_number"], advice)


def test_earlier_transforms_use_action_units():
    assert advised([0.3], BiasedAdvice(0.3)).reset()["guide_action"].tolist() == [[[0, 0, 0, 1, 0]]]
    assert close(
        step(advised([0.3, 0.3], ResidualAction(0.5)), 4, 1)["next", "steering"], [0.8, 0.05]
    )
    assert close(step(advised([0.3], Takeover(1.0)), 4)["next", "steering"], [0.3])
    after = step(advised([0.3] * 5, RewardCoupling(1.0)), 0, 1, 2, 3, 4)
    assert close(after["next", "guide_distance"], [1.3, 0.8, 0.3, 0.2, 0.7])
    assert step(advised([0.3], RemovedAdvice()), 1)["next", "guide_action"].tolist() == [
        [[0, 1, 0, 0, 0]]
    ]
