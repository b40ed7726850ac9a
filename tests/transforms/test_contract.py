"""Properties shared by the transforms: valid specs, draws by their state, and refusals."""

import math

import pytest
import torch
import worlds
from tensordict import TensorDict
from torchrl.envs import Compose, PendulumEnv, TransformedEnv

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import ConstantGuide, RandomGuide, SplineGuide, ZeroGuide
from coil_rl.testing import check_env, check_transform
from coil_rl.transforms import (
    ActionDelay,
    AdaptiveMixedAction,
    AdviceDropout,
    BiasedAdvice,
    DelayedAdvice,
    DiscreteActions,
    GradualResidual,
    GuideActions,
    JumpStart,
    NoisyAdvice,
    ObservationDelay,
    PartialAdvice,
    RandomAdvice,
    RemovedAdvice,
    ResidualAction,
    RewardCoupling,
    ScaledAdvice,
    ShuffledAdvice,
    Takeover,
)
from coil_rl.transforms.guide_actions import Guides

TRANSFORMS = {
    "advice only": Compose,
    "biased": BiasedAdvice,
    "dropout": AdviceDropout,
    "delayed": lambda: DelayedAdvice(2),
    "delayed actions": lambda: ActionDelay(1, 2),
    "delayed observations": lambda: ObservationDelay(1, 2),
    "jump start": lambda: JumpStart(4, random=True),
    "noisy": NoisyAdvice,
    "partial": lambda: PartialAdvice("left"),
    "random": RandomAdvice,
    "random guide": lambda: GuideActions({"random": RandomGuide()}, out_key="other_advice"),
    "removed": RemovedAdvice,
    "reward coupling": lambda: RewardCoupling(0.5),
    "scaled": lambda: ScaledAdvice(0.5),
    "takeover": lambda: Takeover(0.5),
    "warm start": lambda: Takeover(1.0, 3),
}
FOR_NUMBERS = {
    "adaptive mixing": lambda: AdaptiveMixedAction(warm_up=12),
    "gradual residual": lambda: GradualResidual(0.2, probability=0.5),
    "residual": ResidualAction,
}


@pytest.mark.fast(2)
@pytest.mark.parametrize("name", TRANSFORMS)
def test_specs_hold_in_every_env(name):
    for world in (worlds.cones, worlds.pendulum, worlds.carts):
        check_env(world(TRANSFORMS[name]()).train(), steps=4)


@pytest.mark.parametrize("name", FOR_NUMBERS)
def test_specs_hold_in_envs_with_continuous_actions(name):
    for world in (worlds.cones, worlds.pendulum):
        check_env(world(FOR_NUMBERS[name]()).train(), steps=4)
    with pytest.raises(ValueError, match="needs continuous actions, but this env has 2 discrete"):
        worlds.carts(FOR_NUMBERS[name]()).train().reset()


def test_specs_hold_with_several_guides_and_another_key():
    key, classes = ("advice", "middle"), (NoisyAdvice, ShuffledAdvice, DelayedAdvice, RemovedAdvice)
    guides = GuideActions({"constant": ConstantGuide(0.5), "spline": SplineGuide()}, out_key=key)
    degraded = Compose(guides, *(make(key=key) for make in classes))
    env = TransformedEnv(ConeTrackEnv(shipped_tracks("test"), 6), degraded)
    check_env(env)
    assert env.reset()[key].eq(0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "transforms",
    [
        [ResidualAction(0.5), RewardCoupling(0.1), Takeover(0.5)],
        [JumpStart(3), DelayedAdvice(3)],
        [RemovedAdvice()],
    ],
)
def test_specs_hold_with_discrete_actions(transforms):
    check_env(worlds.cones(*transforms, DiscreteActions(3)).train(), steps=5)
    check_transform(ConeTrackEnv(shipped_tracks("test"), 3), DiscreteActions(7))


def degraded(transform):
    return transform(TensorDict({"guide_action": torch.zeros(1, 1, 1)}, [1]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Guides({}), "at least one guide"),
        (lambda: Guides({"half": ZeroGuide()}), "'half' cannot be the name of a guide"),
        (lambda: Guides({"a": ZeroGuide(out_key="b")}), r"must write 'action'; it writes \['b'\]"),
        (lambda: Guides({"zero": ZeroGuide()}, trainable=True), "guide 'zero' has no parameters"),
        (lambda: worlds.cones(RewardCoupling(1, guide=1)).rollout(1), "reads row 1 of guide"),
        (lambda: worlds.carts(DiscreteActions(5)).reset(), "the action of this env is choices"),
        (lambda: AdaptiveMixedAction(low=0.4), "low=0.4, .* must be in this order"),
        (lambda: AdaptiveMixedAction(certain=0.2), "certain=0.2 .* less than uncertain=0.15"),
        (lambda: AdviceDropout(1.5), r"probability=1\.5 must be at most 1"),
        (lambda: DiscreteActions(1), "choices=1 must be at least 2"),
        (lambda: DiscreteActions([0.5, 0.5]), "must be at least two increasing numbers"),
        (lambda: DiscreteActions([0.0, math.inf]), "must be finite"),
        (lambda: RandomAdvice(1.0, 0.5), r"low=1\.0 must be less than high=0\.5"),
        (lambda: BiasedAdvice(math.nan), "offset=nan must be a finite number"),
        (lambda: ScaledAdvice(math.inf), "gain=inf must be a finite number"),
        (lambda: degraded(DelayedAdvice()), "DelayedAdvice needs the previous steps"),
        (lambda: degraded(RemovedAdvice()), "RemovedAdvice needs the previous steps"),
        (lambda: worlds.cones(ShuffledAdvice(), cars=1).reset(), "the batch is one row; use more"),
        (lambda: worlds.pendulum(ShuffledAdvice()).reset(), "the batch is one row; use more"),
        (lambda: check_env(TransformedEnv(PendulumEnv(), BiasedAdvice())), "behind GuideActions"),
    ],
)
def test_invalid_arguments_and_envs_are_refused(make, message):
    with pytest.raises((ValueError, RuntimeError, KeyError), match=message):
        make()
