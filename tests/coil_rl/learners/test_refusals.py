"""Refusals of the learners: values out of range, options without effect, unusable envs, guides."""

import math

import pytest
import torch
import worlds
from any_env import AnyEnv
from cart_poles import CartPoles
from tensordict.nn import TensorDictModule
from torchrl.data import Binary, Bounded, Categorical, MultiCategorical, MultiOneHot, Unbounded

from coil_rl.learners import (
    A2C,
    DQN,
    PPO,
    SAC,
    TQC,
    TRPO,
    Anchor,
    CrossQ,
    DynamicCoil,
    FilteredKickstartLoss,
    Gru,
    KickstartLoss,
    Reinforce,
)
from coil_rl.learners.encoders import Cnn, Mlp, ObservationNetwork
from coil_rl.learners.networks import FastTensorDictModule
from coil_rl.schedules import Linear
from coil_rl.transforms import MixedAction, ResidualAction, RewardCoupling, Takeover


def choices():
    return AnyEnv(action=MultiCategorical([2, 3]))


def small_images():
    return AnyEnv(observations={"image": Bounded(0, 255, (7, 7, 3), dtype=torch.uint8)})


def with_memory(state):
    return worlds.cones(*Gru(state=state).env_transforms())


def driver():
    network = ObservationNetwork(worlds.cones(), ["observation"], Mlp([8]), 1, 1.0)
    return FastTensorDictModule(network, ["observation"], ["action"])


def dynamic(env=None, **options):
    return DynamicCoil(env or worlds.cones(), **{"guides": {"one": driver()}} | options)


def imitating(kind, loss=None):
    return kind(worlds.cones(), anchor=Anchor(), auxiliary=[loss or KickstartLoss()])


def constant():
    return TensorDictModule(lambda seen: seen[..., :1] * 0, ["observation"], ["action"])


COMMON = {"gamma": 2, "learning_rate": -1, "action_gain": -1, "hidden": [0], "seed": -1}
COMMON |= {"normalise": "sometimes"}
REPLAY = {"tau": 2, "batch_size": 0, "capacity": 10, "updates_per_step": -1, "starts": -1}
OWN = {"minibatches": 0, "action_scale": 0, "epochs": 0, "clip": 0, "entropy": -1, "critic": -1}
OUT_OF_RANGE = [
    (PPO, COMMON | OWN | {"max_grad_norm": math.inf}),
    (A2C, {"gae_lambda": -1, "minibatches": 0}),
    (Reinforce, {"baseline": "mean", "gamma": 2}),
    (TRPO, {"max_kl": 0, "damping": -1, "iterations": 0, "backtracks": -1, "shrink": 1.5}),
    (DQN, COMMON | REPLAY | {"max_grad_norm": 0, "epsilon": Linear(0.5, 2.0)}),
    (SAC, COMMON | REPLAY | {"max_grad_norm": 0, "temperature": 0, "action_scale": 0}),
    (lambda env, **options: Anchor(**options), {"reach": 0, "choice_weight": 0, "share": 2}),
    (lambda env, **options: Anchor(**options), {"gains": [1.5]}),
    (lambda env, **options: Anchor(**options), {"gains": [0.0]}),
    (dynamic, {"shrink": 0, "critic_phases": "never", "guide_learning_rate": math.nan}),
]


@pytest.mark.parametrize(("kind", "values"), OUT_OF_RANGE)
def test_values_out_of_range_are_refused(kind, values):
    env = AnyEnv(action=Categorical(3, ()) if kind is DQN else None)
    for name, value in values.items():
        with pytest.raises(ValueError, match=rf"{name}.*=.* must be"):
            kind(env, **{name: value})


@pytest.mark.parametrize(
    ("kind", "name"), [(A2C, "clip"), (A2C, "epochs"), (Reinforce, "entropy"), (TRPO, "critic")]
)
def test_options_that_have_no_effect_are_refused(kind, name):
    with pytest.raises(TypeError, match=name):
        kind(CartPoles(2), **{name: 1})


@pytest.mark.parametrize(
    ("transform", "message"),
    [
        (ResidualAction(Linear(0, 1)), "scale of ResidualAction changes over the run"),
        (MixedAction(Linear(0, 1)), "weight of MixedAction changes over the run"),
        (RewardCoupling(Linear(1, 0)), "beta of RewardCoupling changes over the run"),
    ],
)
def test_replay_refuses_an_effect_of_actions_that_changes_over_the_run(transform, message):
    with pytest.raises(ValueError, match=f"{message}.* use a learner without replay, such as PPO"):
        SAC(worlds.pendulum(transform), ["th"])
    # The probability that the guide acts may change.
    SAC(worlds.pendulum(ResidualAction(0.5), Takeover(Linear(1, 0))), ["th"])


NO_MEMORY = "cannot train a network with a memory"
SIZES = "must have one number for each convolution"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PPO(AnyEnv(action=MultiOneHot([2, 3]))), "is MultiOneHot .* transform it"),
        (lambda: PPO(AnyEnv(action=Unbounded((2,), dtype=torch.long))), "is Unbounded.*int64"),
        (lambda: DQN(choices()), "DQN needs one discrete action, .* use PPO"),
        (lambda: DQN(AnyEnv(action=Binary(3))), "DQN needs one discrete action, .* use PPO"),
        (lambda: DQN(AnyEnv()), "DQN needs discrete actions, .* around it: action=choices"),
        (lambda: SAC(choices()), "SAC needs continuous actions, .* or learner=ppo"),
        (lambda: SAC(AnyEnv(agents=True)), "needs one entry action .* RenameTransform, or use PPO"),
        (lambda: PPO(AnyEnv(), ["sight"]), "no entry sight to observe; it has observation"),
        (lambda: Cnn(channels=[1], kernels=[3], strides=[]), SIZES),
        (lambda: Cnn(channels=[], kernels=[], strides=[]), SIZES),
        (lambda: PPO(AnyEnv(), network=Cnn()), "an image among observation.* use network=mlp"),
        (lambda: PPO(small_images(), ["image"], network=Cnn()), r"\[7, 7, 3\] is too small"),
        (lambda: PPO(AnyEnv(), network=Gru()), "the env does not carry the memory of the network"),
        (lambda: PPO(with_memory(8), network=Gru()), "the env does not carry the memory"),
        (lambda: Gru(state=0), "state=0 must be at least 1"),
        (lambda: SAC(AnyEnv(), network=Gru()), f"SAC {NO_MEMORY}; take network=mlp"),
        (lambda: DQN(AnyEnv(action=Categorical(3, ())), network=Gru()), f"DQN {NO_MEMORY}"),
        (lambda: TRPO(AnyEnv(), network=Gru()), f"TRPO {NO_MEMORY}"),
        (lambda: dynamic(network=Gru()), f"DynamicCoil {NO_MEMORY}"),
        (lambda: dynamic(compile=True), "compile=true: this learner's update depends on data"),
        (lambda: dynamic(guides={"still": constant()}), "guide 'still' has no parameters"),
        (lambda: dynamic(guides=dict.fromkeys("ab", driver())), "two guides share parameters"),
        (lambda: PPO(AnyEnv(), auxiliary=[FilteredKickstartLoss()]), "take learner=sac"),
        (lambda: PPO(AnyEnv(), auxiliary=[KickstartLoss()]), "row 0 of guide_action.* no advice"),
        (lambda: imitating(PPO, KickstartLoss(guide=1)), "row 1 of guide_action.* of 1 guides"),
        (lambda: KickstartLoss(guide=-1), "guide=-1 must be at least 0"),
        (
            lambda: imitating(PPO),
            "an anchored policy learns is added to its guide's.* learner.anchor",
        ),
        (
            lambda: imitating(SAC),
            "an anchored policy learns is added to its guide's.* learner.anchor",
        ),
        (lambda: SAC(AnyEnv(), critics=1), "critics=1 must be"),
        (lambda: SAC(AnyEnv(), critics=4, target_critics=4), "at least 1 and less than critics=4"),
        (lambda: SAC(AnyEnv(), prior=0.5), r"prior=0\.5 needs steps in which a guide acts"),
        (lambda: SAC(AnyEnv(), prior=1.5), r"prior=1\.5 must be"),
        (lambda: CrossQ(AnyEnv(), tau=0.1), "tau=0.1 must be None: CrossQ"),
        (lambda: CrossQ(AnyEnv(), critic_layer_norm=True), "critic_layer_norm=True and"),
        (lambda: TQC(AnyEnv(), dropped=25), "dropped=25 must be less than quantiles=25"),
        (lambda: TQC(AnyEnv(), target_critics=1), "all critics of TQC give the target"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_sentence(make, message):
    with pytest.raises((ValueError, KeyError), match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
