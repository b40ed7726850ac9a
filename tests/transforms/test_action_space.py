"""Advice in the many forms in which guides give it, for every kind of action."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.nn.functional import one_hot
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    Unbounded,
)
from torchrl.envs import Compose, EnvBase, TransformedEnv

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


class Copies(EnvBase):
    """B rows, or B rows of agents; the observation is a counter of the row."""

    def __init__(self, action, agents=0, dtype=torch.float32):
        batch = action.shape[:1]
        super().__init__(batch_size=batch)
        lead = (*batch, agents) if agents else batch
        self.path = ("agents",) if agents else ()
        group = Composite(observation=Unbounded((*lead, 2), dtype=dtype), shape=lead)
        flags = Binary(shape=(*batch, 1), dtype=torch.bool)
        reward = Unbounded((*lead, 1), dtype=dtype)
        if agents:
            self.observation_spec = Composite(agents=group, shape=batch)
            self.full_action_spec = Composite(
                agents=Composite(action=action, shape=lead), shape=batch
            )
            self.full_reward_spec = Composite(
                agents=Composite(reward=reward, shape=lead), shape=batch
            )
        else:
            self.observation_spec, self.action_spec, self.reward_spec = group, action, reward
        self.full_done_spec = Composite(
            done=flags, terminated=flags.clone(), truncated=flags.clone(), shape=batch
        )
        self.received = None

    def _data(self, **more):
        data = TensorDict(
            {**self.full_done_spec.zero(), **self.observation_spec.zero()}, self.batch_size
        )
        observation = data[(*self.path, "observation")]
        observation += torch.arange(float(observation[..., 0].numel())).view(
            *observation.shape[:-1], 1
        )
        for key, value in more.items():
            data.set((*self.path, key), value)
        return data

    def _reset(self, tensordict=None, **_):
        return self._data()

    def _step(self, tensordict):
        self.received = tensordict[(*self.path, "action")]
        return self._data(reward=self.full_reward_spec[(*self.path, "reward")].zero())

    def _set_seed(self, seed):
        pass


def guided(action, give, **options):
    guide = TensorDictModule(give, in_keys=["observation"], out_keys=["action"])
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
    low, high = (
        torch.tensor([[-1.0, 0.0]] * 4, dtype=dtype),
        torch.tensor([[1.0, 2.0]] * 4, dtype=dtype),
    )
    for network in (nn.Linear(2, 2), nn.Linear(2, 2).double()):
        nn.init.ones_(network.weight)
        nn.init.constant_(network.bias, -2)
        env = guided(Bounded(low, high, (4, 2), dtype=dtype), network, dtype=dtype)
        check_env(env, steps=2)
        expected = torch.tensor([[-1, 0], [0, 0], [1, 2], [1, 2]], dtype=dtype)
        assert torch.equal(env.reset()["guide_action"][:, 0], expected)


@pytest.mark.parametrize(
    ("spec", "action", "message"),
    [
        (
            Unbounded((4, 1)),
            torch.zeros(4),
            r"the action of guide 'give' has the shape \[4\], but must have \[4, 1\]",
        ),
        (
            Unbounded((4, 1)),
            torch.full((4, 1), torch.nan),
            "guide 'give' holds a number that is not finite",
        ),
        (
            Categorical(3, (4,)),
            torch.zeros(4, 2),
            r"has the shape \[4, 2\], but must have \[4, 3\]",
        ),
        (
            Categorical(3, (4,)),
            torch.tensor([0, 1, 2, 3]),
            "'give' is neither an index below 3 nor a one-hot vector",
        ),
        (
            OneHot(3, (4, 3)),
            torch.full((4, 3), 2.5),
            "is neither an index below 3 nor a one-hot vector",
        ),
        (
            Categorical(3, (4,)),
            torch.zeros(4, 3),
            "is no one-hot vector: it must have exactly one 1 for each choice",
        ),
        (
            MultiCategorical([2, 2], (4, 2)),
            torch.tensor([1.0, 0.0, 1.0, 1.0]).expand(4, 4),
            "is no one-hot vector: it must have exactly one 1 for each choice",
        ),
        (Unbounded((4,)), torch.zeros(4), "advice needs a vector of real numbers or choices"),
        (
            Bounded(0, 9, (4, 1), dtype=torch.int64),
            torch.zeros(4),
            "advice needs a vector of real numbers or choices",
        ),
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
    guide = TensorDictModule(
        lambda x: (x[..., :1] if number else x[..., 0].long()).clamp(max=4),
        in_keys=[("agents", "observation")],
        out_keys=[("agents", "action")],
    )
    guides = GuideActions({"count": guide}, ["agents", "action"], ["agents", "advice"])
    transforms = (
        [ResidualAction(0.0, **KEYS), MixedAction(1.0, **KEYS)]
        if number
        else [Takeover(0.0, **KEYS)]
    )
    env = TransformedEnv(
        Copies(spec, 3), Compose(guides, *transforms, RewardCoupling(1.0, **KEYS))
    ).train()
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
    guide = TensorDictModule(
        lambda x: MULTI[x[:, 0].long()], in_keys=["observation"], out_keys=["action"]
    )
    env = TransformedEnv(Copies(spec), Compose(GuideActions({"a": guide}), RemovedAdvice()))
    check_env(env, steps=2)
    action = torch.tensor([[2, 1], [0, 0], [1, 1], [0, 1]])
    after = env.step(env.reset().set("action", action))["next"]
    assert after["guide_action"][0, 0].tolist() == [0, 0, 1, 0, 1]


RANGES = {
    "unit": (Bounded(-1, 1, (2, 1)), None, "from [-1.0] to [1.0]"),
    "wide": (Bounded(20, 80, (2, 1)), None, "from [20.0] to [80.0]"),
    "two": (Bounded(-1, 1, (2, 2)), None, "from [-1.0, -1.0] to [1.0, 1.0]"),
    "no upper bound": (
        Bounded(torch.full((2, 1), -1.0), torch.full((2, 1), torch.inf)),
        None,
        "from [-1.0] to [inf]",
    ),
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


def test_ranges_are_told_apart_in_any_unit_and_equal_up_to_rounding():
    unit = ActionSpace(Bounded(-1e-9, 1e-9, (2, 1)), 1).range
    assert not unit.same_as(ActionSpace(Bounded(0.0, 1e-9, (2, 1)), 1).range)
    assert unit.same_as(ActionSpace(Bounded(-1e-9, 1e-9 * (1 + 1e-7), (2, 1)), 1).range)


def test_one_hot_choices_are_those_of_an_index():
    assert ActionSpace(OneHot(3, (2, 3)), 1).range.same_as(
        ActionSpace(Categorical(3, (2,)), 1).range
    )


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
