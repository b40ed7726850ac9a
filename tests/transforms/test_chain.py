"""A chain executes what its env executes, and remembers what its env remembers."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Unbounded
from torchrl.envs import (
    CatFrames,
    Compose,
    InitTracker,
    ObservationNorm,
    RewardScaling,
    StepCounter,
    TensorDictPrimer,
    TimeMaxPool,
    TransformedEnv,
)

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.errors import UserError
from coil_rl.guides import SplineGuide, SplineMemoryGuide
from coil_rl.transforms import (
    ActionDelay,
    AdaptiveMixedAction,
    AdviceDropout,
    DelayedAdvice,
    DiscreteActions,
    GradualResidual,
    GuideActions,
    JumpStart,
    LastAction,
    NormalisedAction,
    ObservationDelay,
    RemovedAdvice,
    ResidualAction,
    ScaledAdvice,
)
from coil_rl.transforms.chain import Chain, links_of

STEPS = 5


class Agent(TensorDictModuleBase):
    """Acts by all that it observes; remembers a sum, and starts anew where an episode begins."""

    out_keys = ("action", ("next", "total"), ("next", "uncertainty"))

    def __init__(self, *observed, choices=None):
        self.in_keys, self.choices = [*observed, "total", "is_init"], choices
        self.observed = observed
        super().__init__()

    def forward(self, data):
        total = torch.where(data["is_init"], 0.3, data["total"])
        total = total + sum(data[key].float().flatten(1).sum(-1, True) for key in self.observed)
        wave = (total / 5).sin()
        index = ((wave + 1) / 2 * (self.choices or 1)).long().clamp(max=(self.choices or 1) - 1)
        data.set("action", wave if self.choices is None else index.squeeze(-1))
        return data.set(("next", "total"), total).set(("next", "uncertainty"), wave.abs() / 9)


def env_of(guide, *transforms):
    cars = ConeTrackEnv(shipped_tracks("test"), 4, rate=6)
    primer = TensorDictPrimer({"total": Unbounded((1,))}, expand_specs=True, default_value=0.5)
    parts = [NormalisedAction(), GuideActions({"guide": guide}), *transforms]
    return TransformedEnv(cars, Compose(*parts, InitTracker(), primer)).eval()


CASES = {
    "advice": (lambda: [], ["guide_action"]),
    "residual of a memory": (lambda: [ResidualAction(0.5), LastAction(2)], ["last_action"]),
    "adaptive mixing": (lambda: [AdaptiveMixedAction(warm_up=0)], ["agent_weight"]),
    "dropout": (lambda: [AdviceDropout(), JumpStart(3)], ["advice_given", "guide_action"]),
    "gradual, scaled": (lambda: [ScaledAdvice(0.5), GradualResidual(0.5)], ["guide_action"]),
    "delayed": (lambda: [DelayedAdvice(2)], ["guide_action"]),
    "removed": (lambda: [RemovedAdvice()], ["guide_action"]),
    "choices": (lambda: [ResidualAction(0.5), DiscreteActions(3), LastAction()], ["last_action"]),
    "of TorchRL": (lambda: [StepCounter(step_count_key="count")], ["count"]),
}


@pytest.mark.fast(3)
@pytest.mark.parametrize("guide", [SplineGuide, SplineMemoryGuide])
@pytest.mark.parametrize("case", CASES)
def test_chain_executes_what_the_env_executes(case, guide):
    transforms, observed = CASES[case]
    env = env_of(guide(), *transforms())
    policy = Agent("steering", *observed, choices=3 if case == "choices" else None)
    chain, given = Chain(env, policy), []
    for _ in range(2):
        carrier, past = env.reset(), None
        for _ in range(STEPS):
            entries = carrier.select(*env.base_env.observation_spec.keys(), *env.done_keys)
            sent, past = chain(entries.set("reward", torch.zeros(4, 1)), past)
            carrier = policy(carrier)
            given.append(env.transform.inv(carrier)["action"])
            assert torch.equal(sent["action"], given[-1])
            carrier = env.step_mdp(env.step(carrier))
    assert torch.stack(given).unique().numel() > 2


def test_disturbances_and_rewards_are_left_out():
    parts = [ObservationDelay(1, 1), ActionDelay(1, 1), RewardScaling(0.0, 2.0)]
    env = env_of(SplineGuide(), *parts)
    assert [type(link) for link in links_of(env.transform)] == [NormalisedAction, GuideActions]


HISTORY = {"in_keys": ["observation"], "out_keys": ["past"]}


@pytest.mark.parametrize("remembers", [CatFrames(3, -1, **HISTORY), TimeMaxPool(T=2, **HISTORY)])
def test_transform_that_remembers_in_its_own_way_is_refused_where_states_are_tensors(remembers):
    env = env_of(SplineGuide(), ObservationNorm(0.1, 2.0, in_keys=["observation"]))
    assert len([*links_of(env.transform, tensors=True)]) == 3
    env.append_transform(remembers)
    assert len([*links_of(env.transform)]) == 4
    with pytest.raises(UserError, match=f"{type(remembers).__name__} remembers earlier steps"):
        [*links_of(env.transform, tensors=True)]


def test_what_does_not_change_in_an_episode_is_not_remembered():
    env = env_of(SplineMemoryGuide(), AdviceDropout(), JumpStart(3), LastAction())
    chain = Chain(env, Agent("steering"))
    names = {key for _, key in chain.remembered(chain.first(TensorDict({}, [1])))}
    assert {"last_action", "total", "is_init"} < names
    assert not {"advice_given", "guide_steps"} & names
    assert any(key[:2] == ("guide_state", "guide") for key in names)


def test_rows_of_an_env_and_of_a_chain_need_not_be_as_many():
    env = env_of(SplineMemoryGuide(), ResidualAction(0.5), DelayedAdvice(2), LastAction())
    chain = Chain(env, Agent("steering", "guide_action", "last_action"))
    first = env.base_env.reset().select(*env.base_env.observation_spec.keys())
    whole, past = chain(first.copy(), None)
    for rows in (slice(0, 1), slice(1, 4)):
        part, own = chain(first[rows].copy(), None)
        torch.testing.assert_close(part["action"], whole["action"][rows], rtol=0, atol=1e-6)
        for all_rows, few in zip(past, own, strict=True):
            for key, value in few.items():
                torch.testing.assert_close(value, all_rows[key][rows], rtol=0, atol=1e-5)
