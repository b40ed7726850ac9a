"""The unit of the action: guides and env speak the env's, all else the normalised one."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, MultiDiscrete
from plants import Plant
from torchrl.envs import TransformedEnv
from worlds import acting

from coil_rl.foreign.gymnasium_env import GymnasiumEnv
from coil_rl.guides import ConstantGuide, ZeroGuide
from coil_rl.guides.simple import FollowAdvice
from coil_rl.transforms import (
    BiasedAdvice,
    DiscreteActions,
    GuideActions,
    NormalisedAction,
    RemovedAdvice,
    ResidualAction,
    RewardCoupling,
    ScaledAdvice,
)
from coil_rl.transforms.normalised_action import ActionUnits, normalising

INF = np.inf


def box(low, high, dtype=np.float32):
    return Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)


def advised(space, guide, *transforms, normalised=True):
    env = GymnasiumEnv(lambda: Plant(actions=space))
    first = normalising(env) if normalised else []
    env = TransformedEnv(env)
    for transform in (*first, GuideActions({"guide": guide}), *transforms):
        env.append_transform(transform)
    return env.eval()


def got(env):
    (plant,) = env.base_env.held.plants
    return np.array(plant.env.given)


def followed(env, steps=3):
    """Return the actions that the env got while its guide acted."""
    env.rollout(steps, FollowAdvice(env))
    return got(env)


@pytest.mark.parametrize("normalised", [True, False], ids=["normalised", "own unit"])
@pytest.mark.parametrize(
    ("low", "high"),
    [([-1], [1]), ([0], [1]), ([0], [2000]), ([200], [1000]), ([0, -5], [1, 3000]), ([3], [INF])],
    ids=str,
)
def test_guides_act_in_the_unit_of_the_env(low, high, normalised):
    top = np.where(np.isfinite(high), high, np.array(low) + 2.0)
    value = (np.array(low) + 0.3 * (top - np.array(low))).tolist()
    env = advised(box(low, high), ConstantGuide(value), normalised=normalised)
    np.testing.assert_allclose(followed(env), np.tile(value, (3, 1)), rtol=1e-6)
    if normalised:
        torch.testing.assert_close(env.reset()["guide_action"], torch.full((1, 1, len(low)), -0.4))


def test_units_of_bounds():
    units = ActionUnits(torch.tensor([0.0, 3, -INF, -INF]), torch.tensor([10.0, INF, 3, INF]))
    assert units.centre.tolist() == [5, 4, 2, 0]
    assert units.unit.tolist() == [5, 1, 1, 1]
    assert units.low.tolist() == [-1, -1, -INF, -INF]
    assert units.high.tolist() == [1, INF, 1, INF]
    assert units.assumed == [
        "coordinate 1 has no upper bound: it counts in units of 1 around 4",
        "coordinate 2 has no lower bound: it counts in units of 1 around 2",
        "coordinate 3 has no bounds: it counts in units of 1 around 0",
    ]
    largest = torch.full((1,), torch.finfo(torch.float32).max)
    assert ActionUnits(-largest, largest).identity  # the largest number stands for infinity
    with pytest.raises(ValueError, match="each lower one must be below the upper one"):
        ActionUnits(torch.tensor([1.0]), torch.tensor([1.0]))


def test_an_action_between_minus_one_and_one_is_left_alone():
    assert normalising(GymnasiumEnv(lambda: Plant(actions=box([-1, -1], [1, 1])))) == []
    assert normalising(GymnasiumEnv(lambda: Plant(actions=Discrete(3)))) == []


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (box([0], [2000]), [1000]),
        (box([200, -1], [1000, 1]), [600, 0]),
        (box([3], [INF]), [4]),
        (Discrete(3, start=1), 1),
        (MultiDiscrete([3, 2]), [0, 0]),
        (box([-2], [2], np.int64), [-2]),
    ],
    ids=str,
)
def test_zero_guide_is_neutral(space, expected):
    assert followed(advised(space, ZeroGuide()), 1)[0].tolist() == expected


def test_number_that_the_env_does_not_have_is_refused():
    with pytest.raises(ValueError, match=r"neither a number from \[1\] to \[3\] nor a one-hot"):
        advised(Discrete(3, start=1), ConstantGuide(0)).reset()
    with pytest.raises(ValueError, match="is no whole number, but must be the number of a choice"):
        advised(Discrete(3), ConstantGuide([0.5])).reset()


@pytest.mark.parametrize("normalised", [True, False], ids=["normalised", "own unit"])
def test_degraded_advice_is_degraded_in_normalised_actions(normalised):
    space = box([0, 100], [1, 300])
    for transform, expected in [
        (ScaledAdvice(0.0), [0.5, 200]),
        (ScaledAdvice(-1.0), [0.75, 260]),
        (ScaledAdvice(0.5), [0.375, 170]),
        (BiasedAdvice(0.2), [0.35, 160]),
        (RemovedAdvice(), [0.5, 200]),
    ]:
        env = advised(space, ConstantGuide([0.25, 140.0]), transform, normalised=normalised)
        np.testing.assert_allclose(followed(env, 1)[0], expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("space", "value", "opposite"), [(box([0], [INF]), [0.25], [1.75]), (Discrete(3), 0, 2)]
)
def test_opposite_of_advice_without_a_middle(space, value, opposite):
    assert followed(advised(space, ConstantGuide(value), ScaledAdvice(-1.0)), 1)[0] == opposite


@pytest.mark.parametrize("normalised", [True, False], ids=["normalised", "own unit"])
def test_residual_and_distance_are_computed_in_normalised_actions(normalised):
    space = box([0, 100], [1, 300])
    transforms = [ResidualAction(0.5), RewardCoupling(1.0)]
    env = advised(space, ConstantGuide([0.25, 140.0]), *transforms, normalised=normalised)
    state = env.reset()
    middle = torch.zeros(1, 2) if normalised else torch.tensor([[0.5, 200.0]])
    after = env.step(state.clone().set("action", middle))["next"]
    np.testing.assert_allclose(got(env)[-1], [0.25, 140], rtol=1e-6)
    top = torch.ones(1, 2) if normalised else torch.tensor([[1.0, 300.0]])
    after = env.step(state.clone().set("action", top))["next"]
    np.testing.assert_allclose(got(env)[-1], [0.5, 190], rtol=1e-6)
    assert float(after["guide_distance"]) == pytest.approx(0.5 * 2**0.5, rel=1e-5)


def test_guide_reads_its_last_action_in_the_unit_of_the_env():
    seen = []

    def act(last):
        seen.append(last.clone())
        return torch.full_like(last, 140.0)

    guide = acting(act, "last_action")
    followed(advised(box([100], [300]), guide))
    assert [round(float(each)) for each in seen[1:]] == [140, 140, 140]


@pytest.mark.parametrize("normalised", [True, False], ids=["normalised", "own unit"])
@pytest.mark.parametrize(("low", "high"), [(-1, 1), (0, 100), (-1, INF), (5, INF)])
def test_action_beyond_the_bounds_counts_as_the_bound_in_any_unit(low, high, normalised):
    seen = []

    def act(last):
        seen.append(float(last))
        return torch.full_like(last, low)

    guide = acting(act, "last_action")
    env = advised(box([low], [high]), guide, RewardCoupling(1.0), normalised=normalised)
    below = -3.0 if normalised else low - 3.0
    after = env.step(env.reset().set("action", torch.tensor([[below]])))["next"]
    assert seen[-1] == low
    assert float(after["guide_distance"]) == 0


def test_normalised_action_outside_an_env_or_behind_advice_says_so():
    with pytest.raises(RuntimeError, match="NormalisedAction needs an env"):
        NormalisedAction().units  # noqa: B018
    guide, behind = ConstantGuide([0.5]), NormalisedAction()
    followed(advised(box([-1], [1]), guide, behind, normalised=False))
    with pytest.raises(ValueError, match="NormalisedAction is behind GuideActions, whose actions"):
        followed(advised(box([-2], [2]), guide, NormalisedAction(), normalised=False))


def test_values_of_choices_are_in_the_unit_of_the_env():
    for choices, expected in [([0.0, 0.5, 2.0], [0.0, 0.5, 2.0]), (3, [0.0, 1.0, 2.0])]:
        env = advised(box([0], [2]), ConstantGuide([0.4]), DiscreteActions(choices))
        state = env.reset()
        for choice in range(3):
            env.step(state.clone().set("action", torch.tensor([choice])))
        np.testing.assert_allclose(got(env).flatten(), expected, atol=1e-6)
    with pytest.raises(ValueError, match=r"must lie between the action's bounds 0.0 and 2.0"):
        advised(box([0], [2]), ConstantGuide([0.4]), DiscreteActions([-0.5, 0.5])).reset()
    with pytest.raises(ValueError, match=r"of one bounded number, .*; leave it out: action=con"):
        advised(box([0], [INF]), ConstantGuide([0.4]), DiscreteActions(3)).reset()
