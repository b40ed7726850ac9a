"""Refusals of the learners: values out of range, options without effect, unusable envs, guides."""

import math

import pytest
import worlds
from cart_poles import CartPoles
from tensordict.nn import TensorDictModule

from coil_rl.learners import A2C, DQN, PPO, SAC, TRPO, DynamicCoil, Reinforce
from coil_rl.learners.encoders import Mlp, ObservationNetwork
from coil_rl.learners.networks import FastTensorDictModule
from coil_rl.schedules import Linear
from coil_rl.transforms import (
    DiscreteActions,
    MixedAction,
    ResidualAction,
    RewardCoupling,
    Takeover,
)

COMMON = {
    "gamma": 2,
    "learning_rate": -1,
    "action_gain": -1,
    "hidden": [0],
    "max_grad_norm": 0,
    "seed": -1,
}
REPLAY = {"tau": 2, "batch_size": 0, "capacity": 10, "updates_per_step": -1, "starts": -1}
OUT_OF_RANGE = {
    PPO: COMMON
    | {
        "max_grad_norm": math.inf,
        "minibatches": 0,
        "action_scale": 0,
        "epochs": 0,
        "clip": 0,
        "entropy": -1,
        "critic": -1,
    },
    A2C: {"gae_lambda": -1, "minibatches": 0},
    Reinforce: {"baseline": "mean", "gamma": 2},
    TRPO: {"max_kl": 0, "damping": -1, "iterations": 0, "backtracks": -1, "shrink": 1.5},
    DQN: COMMON | REPLAY | {"epsilon": Linear(0.5, 2.0)},
    SAC: COMMON | REPLAY | {"temperature": 0, "action_scale": 0},
}


@pytest.mark.parametrize("kind", OUT_OF_RANGE)
def test_values_out_of_range_are_refused(kind):
    env = worlds.pendulum(*([DiscreteActions(5)] if kind is DQN else []))
    for name, value in OUT_OF_RANGE[kind].items():
        with pytest.raises(ValueError, match=rf"{name}.*=.* must be"):
            kind(env, ["th"], **{name: value})


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


def test_dynamic_coil_refuses_unusable_guides_and_values_out_of_range():
    env = worlds.cones()
    constant = TensorDictModule(
        lambda observation: observation[..., :1] * 0, ["observation"], ["action"]
    )
    network = ObservationNetwork(env, ["observation"], Mlp([8]), 1, 1.0)
    one = FastTensorDictModule(network, ["observation"], ["action"])
    for guides, message in (
        ({"constant": constant}, "guide 'constant' has no parameters"),
        ({"one": one, "two": one}, "two guides share parameters"),
    ):
        with pytest.raises(ValueError, match=message):
            DynamicCoil(env, guides=guides)
    with pytest.raises(ValueError, match="Dynamic COIL needs continuous actions"):
        DynamicCoil(worlds.carts(), guides={"one": one})
    for name, value in (
        ("shrink", 0),
        ("critic_phases", "never"),
        ("guide_learning_rate", math.nan),
    ):
        with pytest.raises(ValueError, match=rf"{name}.*=.* must be"):
            DynamicCoil(env, guides={"one": one}, **{name: value})
