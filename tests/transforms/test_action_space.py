"""Advice in the many forms in which guides give it, for every kind of action."""

import pytest
import torch
from any_env import AnyEnv
from torch import nn
from torch.nn.functional import one_hot
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    Unbounded,
)
from torchrl.envs import Compose, TransformedEnv
from worlds import acting

from coil_rl.guides import FollowAdvice, RandomGuide
from coil_rl.testing import check_env
from coil_rl.transforms import (
    GuideActions,
    MixedAction,
    RemovedAdvice,
    ResidualAction,
    RewardCoupling,
    Takeover,
)
from coil_rl.transforms.action_space import ActionSpace, random_action


class Copies(AnyEnv):
    """Rows, or rows of agents, whose observation is their number; keeps the action it is given."""

    def __init__(self, action, agents=False, dtype=torch.float32):
        key, shape = (("agents", "observation"), (3, 2)) if agents else ("observation", (2,))
        observation = {key: Unbounded(shape, dtype=dtype)}
        super().__init__(action.shape[0], action[0], observation, dtype, agents)

    def observe(self):
        ((key, spec),) = self.observation_spec.items(True, True)
        numbers = torch.arange(spec.shape[:-1].numel(), dtype=spec.dtype)
        return {key: numbers.view(*spec.shape[:-1], 1).expand(spec.shape)}

    def _step(self, tensordict):
        self.received = tensordict[self.key]
        reward = self.full_reward_spec[self.reward].zero()
        return self._reset().set(self.reward, reward)


def guided(action, give, **options):
    guide = acting(give, "observation")
    return TransformedEnv(Copies(action, **options), GuideActions({"give": guide}))


INDEX = [torch.arange(4) % 3, (torch.arange(4) % 3).unsqueeze(-1)]
VECTOR = one_hot(INDEX[0], 3)
MULTI = torch.stack([INDEX[0], INDEX[0] % 2], -1)
PAIR = torch.cat([VECTOR, one_hot(MULTI[:, 1], 2)], -1)


@pytest.mark.parametrize(
    ("spec", "forms", "vector"),
    [
        (Categorical(3, (4,)), [*INDEX, VECTOR, VECTOR.double()], VECTOR),
        (Categorical(3, (4, 1)), [*INDEX, VECTOR], VECTOR),
        (OneHot(3, (4, 3)), [*INDEX, VECTOR.bool()], VECTOR),
        (MultiCategorical([3, 2], (4, 2)), [MULTI, MULTI.double(), PAIR], PAIR),
        (MultiOneHot([3, 2], (4, 5)), [MULTI, PAIR.float()], PAIR),
        (Binary(shape=(4, 2)), [MULTI % 2], one_hot(MULTI % 2, 2).flatten(1)),
    ],
    ids=["categorical", "with a dimension", "one-hot", "multi", "multi one-hot", "binary"],
)
def test_discrete_advice_is_one_hot_in_whatever_form_a_guide_gives_it(spec, forms, vector):
    for form in forms:
        env = guided(spec, lambda x, form=form: form[x[:, 0].long()])
        check_env(env, steps=2)
        data = env.reset()
        assert torch.equal(data["guide_action"], vector.unsqueeze(1).float())
        sent = FollowAdvice(env)(data)
        assert spec.is_in(sent["action"]), "an agent can follow the advice"
        env.step(sent)
        assert torch.equal(ActionSpace(spec, 1).vectors(env.base_env.received), vector.float())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_numbers_have_the_bounds_and_the_dtype_of_the_action(dtype):
    low, high = torch.tensor([[[-1.0, 0.0]], [[1.0, 2.0]]], dtype=dtype).expand(2, 4, 2)
    for network in (nn.Linear(2, 2), nn.Linear(2, 2).double()):
        nn.init.ones_(network.weight)
        nn.init.constant_(network.bias, -2)
        env = guided(Bounded(low, high, (4, 2), dtype=dtype), network, dtype=dtype)
        check_env(env, steps=2)
        expected = torch.tensor([[-1, 0], [0, 0], [1, 2], [1, 2]], dtype=dtype)
        assert torch.equal(env.reset()["guide_action"][:, 0], expected)
        space = env.observation_spec["guide_action"].space
        assert torch.equal(space.low[:, 0], low)
        assert torch.equal(space.high[:, 0], high)


@pytest.mark.parametrize(
    ("spec", "action", "message"),
    [
        (Unbounded((4, 1)), torch.zeros(4), r"guide 'give' has the shape \[4\], .* have \[4, 1\]"),
        (Unbounded((4, 1)), torch.full((4, 1), torch.nan), "a number that is not finite"),
        (Categorical(3, (4,)), torch.zeros(4, 2), r"shape \[4, 2\], but must have \[4, 3\]"),
        (Categorical(3, (4,)), torch.arange(4), r"number from \[0\] to \[2\] nor a one-hot"),
        (OneHot(3, (4, 3)), torch.full((4, 3), 2.5), r"number from \[0\] to \[2\] nor a one-hot"),
        (Categorical(3, (4,)), torch.zeros(4, 3), "must have exactly one 1 for each choice"),
        (MultiCategorical([2, 2], (4, 2)), torch.tensor([[1.0, 0, 1, 1]] * 4), "exactly one 1"),
        (Unbounded((4,)), torch.zeros(4), "needs a vector of real numbers or choices"),
        (Bounded(0, 9, (4, 1), dtype=torch.int64), torch.zeros(4), "needs a vector of real"),
    ],
)
def test_action_that_the_env_does_not_have_is_refused(spec, action, message):
    with pytest.raises(ValueError, match=message):
        guided(spec, lambda _: action).reset()


KEYS = {"action_key": ("agents", "action"), "advice_key": ("agents", "advice")}


@pytest.mark.parametrize("number", [False, True])
def test_advice_of_several_agents(number):
    """Each agent of a row has its own advice; the other transforms find it under nested keys."""
    spec = Bounded(-9, 9, (4, 3, 1)) if number else Categorical(5, (4, 3))
    guide = acting(
        lambda x: (x[..., :1] if number else x[..., 0].long()).clamp(max=4),
        ("agents", "observation"),
        out=("agents", "action"),
    )
    guides = GuideActions({"count": guide}, ["agents", "action"], ["agents", "advice"])
    mixed = [ResidualAction(0.0, **KEYS), MixedAction(1.0, **KEYS)]
    transforms = mixed if number else [Takeover(0.0, **KEYS)]
    agents = Copies(spec, agents=True)
    env = TransformedEnv(agents, Compose(guides, *transforms, RewardCoupling(1.0, **KEYS))).train()
    check_env(env, steps=3)
    data = env.reset()
    expected = torch.arange(12).view(4, 3).clamp(max=4)
    expected = expected.unsqueeze(-1).float() if number else one_hot(expected, 5).float()
    assert torch.equal(data["agents", "advice"], expected.unsqueeze(-2))
    follow = FollowAdvice(env, in_key=("agents", "advice"), out_key=("agents", "action"))
    after = env.step(follow(data))["next"]
    assert torch.equal(ActionSpace(spec, 1).vectors(env.base_env.received), expected)
    assert after["guide_distance"].shape == (4, 3, 1)
    assert (after["guide_distance"] == 0).all()


def test_removed_advice_is_the_last_action_of_several_choices():
    spec = MultiCategorical([3, 2], (4, 2))
    guide = acting(lambda x: MULTI[x[:, 0].long()], "observation")
    env = TransformedEnv(Copies(spec), Compose(GuideActions({"a": guide}), RemovedAdvice()))
    check_env(env, steps=2)
    action = torch.tensor([[2, 1], [0, 0], [1, 1], [0, 1]])
    after = env.step(env.reset().set("action", action))["next"]
    assert after["guide_action"][0, 0].tolist() == [0, 0, 1, 0, 1]


UNLIMITED = torch.full((2, 1), torch.inf)
RANGES = {
    "unit": (Bounded(-1, 1, (2, 1)), None, "from [-1.0] to [1.0]"),
    "wide": (Bounded(20, 80, (2, 1)), None, "from [20.0] to [80.0]"),
    "two": (Bounded(-1, 1, (2, 2)), None, "from [-1.0, -1.0] to [1.0, 1.0]"),
    "no upper bound": (Bounded(-torch.ones(2, 1), UNLIMITED), None, "from [-1.0] to [inf]"),
    "free": (Unbounded((2, 1)), None, "from [-inf] to [inf]"),
    "choices": (Categorical(3, (2,)), None, "from [0.0] to [2.0] in whole numbers"),
    "more choices": (Categorical(4, (2,)), None, "from [0.0] to [3.0] in whole numbers"),
    "later choices": (Categorical(3, (2,)), [5], "from [5.0] to [7.0] in whole numbers"),
}


@pytest.mark.parametrize("name", RANGES)
def test_actions_with_other_numbers_have_other_ranges(name):
    ranges = {}
    for each, (spec, first, _) in RANGES.items():
        ranges[each] = ActionSpace(spec, 1, None if first is None else torch.tensor(first)).range
    assert str(ranges[name]) == RANGES[name][-1]
    assert [each for each in ranges if ranges[name].same_as(ranges[each])] == [name]


def test_ranges_are_equal_up_to_rounding_in_any_unit_and_in_any_encoding():
    unit = ActionSpace(Bounded(-1e-9, 1e-9, (2, 1)), 1).range
    assert not unit.same_as(ActionSpace(Bounded(0.0, 1e-9, (2, 1)), 1).range)
    assert unit.same_as(ActionSpace(Bounded(-1e-9, 1e-9 * (1 + 1e-7), (2, 1)), 1).range)
    index, one_hot = Categorical(3, (2,)), OneHot(3, (2, 3))
    assert ActionSpace(one_hot, 1).range.same_as(ActionSpace(index, 1).range)


@pytest.mark.parametrize(
    ("spec", "low", "high"),
    [
        (Unbounded((1000, 1)), -1.0, 1.0),
        (Bounded(torch.full((1000, 1), 3.0), torch.full((1000, 1), torch.inf)), 3.0, 5.0),
        (Bounded(2.0, 6.0, (1000, 1)), 2.0, 6.0),
    ],
)
def test_random_actions_are_those_of_the_random_guide(spec, low, high):
    env, guide = Copies(spec), RandomGuide()
    guide.meet(ActionSpace(spec, 1), {})
    for actions in (random_action(env, env.reset()), guide(env.reset())):
        drawn = actions["action"]
        assert (drawn >= low).all()
        assert (drawn <= high).all()
        assert drawn.std().item() == pytest.approx((high - low) / 12**0.5, rel=0.1)
