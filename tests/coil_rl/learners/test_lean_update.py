"""A lean update gives the weights of `ClippedLoss` to the bit."""

import pytest
import torch
import worlds
from any_env import AnyEnv
from tensordict.nn import TensorDictModule
from torchrl.data import Unbounded
from torchrl.envs import TransformedEnv

from coil_rl import GymnasiumEnv
from coil_rl.learners import A2C, PPO, Anchor, KickstartLoss
from coil_rl.run.rollout import Rollout
from coil_rl.transforms import GuideActions, NormalisedAction, Takeover

ADVISED = ["observation", "guide_action"]
ANCHORED = {"in_keys": ADVISED, "anchor": Anchor()}


def pendulums():
    return TransformedEnv(GymnasiumEnv("Pendulum-v1", 3), NormalisedAction())


def poles():
    return GymnasiumEnv("CartPole-v1", 3)


def advised_poles():
    leans = TensorDictModule(lambda state: (state[..., 2] > 0).long(), ["observation"], ["action"])
    return TransformedEnv(poles(), GuideActions({"leans": leans}))


def updated(make_env, lean, options):
    """The weights and the metrics after two updates."""
    torch.manual_seed(0)
    env = make_env()
    ppo = PPO(env, **{"minibatches": 3, "epochs": 2, "compile": False} | options)
    rollout = Rollout(env, ppo.policy, 27, ppo.keys)
    assert ppo.lean is not None
    if not lean:
        ppo.lean = None
    metrics = [ppo.update(rollout.collect(), progress) for progress in (0.0, 0.5)]
    assert ppo.gradient.steps == 12
    return [each.detach() for each in ppo.gradient.parameters], metrics


@pytest.mark.parametrize(
    ("make_env", "options"),
    [
        pytest.param(worlds.cones, {"in_keys": ADVISED}, id="squashed"),
        pytest.param(worlds.cones, {"squash": False, "entropy": 0.01}, id="clipped"),
        pytest.param(pendulums, {"normalise": True, "squash": False}, id="normalised"),
        pytest.param(poles, {"normalise": "auto", "entropy": 0.01}, id="choice"),
        pytest.param(lambda: AnyEnv(action=Unbounded((2, 2))), {"entropy": 0.01}, id="unbounded"),
        pytest.param(worlds.cones, {"action_scale": 0.5, "clip": 0.01}, id="much clipped"),
        pytest.param(worlds.cones, ANCHORED, id="anchored"),
        pytest.param(worlds.cones, ANCHORED | {"normalise": True}, id="anchored, normalised"),
        pytest.param(worlds.cones, ANCHORED | {"squash": False}, id="anchored, clipped"),
        pytest.param(advised_poles, ANCHORED, id="anchored choice"),
    ],
)
def test_lean_update_gives_the_same_weights_to_the_bit(make_env, options):
    (ours, our_metrics), (theirs, metrics) = (
        updated(make_env, lean, options) for lean in (True, False)
    )
    assert all(torch.equal(one, other) for one, other in zip(ours, theirs, strict=True))
    for found, expected in zip(our_metrics, metrics, strict=True):
        assert list(found) == list(expected)  # the columns of the log
        assert found == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_what_a_lean_update_does_not_know_keeps_the_loss_of_torchrl():
    assert PPO(worlds.cones()).lean is not None
    assert PPO(worlds.cones(), entropy=0.1).lean is None  # it is estimated from samples
    assert PPO(worlds.cones(), auxiliary=[KickstartLoss()]).lean is None
    assert PPO(worlds.cones(Takeover(0.5))).lean is None
    assert A2C(worlds.cones()).lean is None
    assert PPO(worlds.carts(categorical=False)).lean is None  # a one-hot action
