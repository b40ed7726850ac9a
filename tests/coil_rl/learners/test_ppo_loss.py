"""PPO's loss, equation 92 of the paper, is that of TorchRL."""

import copy

import pytest
import torch
import worlds
from any_env import AnyEnv
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import MultiCategorical, Unbounded
from torchrl.envs import TransformedEnv
from torchrl.objectives import ClipPPOLoss

from coil_rl import GymnasiumEnv
from coil_rl.learners import PPO, Anchor
from coil_rl.run.rollout import Rollout
from coil_rl.transforms import GuideActions, NormalisedAction

ADVISED = ["observation", "guide_action"]
ANCHORED = {"in_keys": ADVISED, "anchor": Anchor()}


def pendulums():
    return TransformedEnv(GymnasiumEnv("Pendulum-v1", 3), NormalisedAction())


def poles():
    return GymnasiumEnv("CartPole-v1", 3)


def advised_poles():
    leans = TensorDictModule(lambda state: (state[..., 2] > 0).long(), ["observation"], ["action"])
    return TransformedEnv(poles(), GuideActions({"leans": leans}))


KINDS = [
    pytest.param(worlds.cones, {"in_keys": ADVISED}, id="squashed"),
    pytest.param(worlds.cones, {"squash": False, "entropy": 0.01}, id="clipped"),
    pytest.param(pendulums, {"normalise": True, "squash": False}, id="normalised"),
    pytest.param(poles, {"normalise": "auto", "entropy": 0.01}, id="choice"),
    pytest.param(lambda: AnyEnv(action=Unbounded((2, 2))), {"entropy": 0.01}, id="unbounded"),
    pytest.param(lambda: AnyEnv(6, MultiCategorical([2, 3])), {"entropy": 0.01}, id="choices"),
    pytest.param(worlds.cones, {"action_scale": 0.5, "clip": 0.01}, id="much clipped"),
    pytest.param(worlds.cones, ANCHORED | {"normalise": True}, id="anchored, normalised"),
    pytest.param(advised_poles, ANCHORED, id="anchored choice"),
]


def reference_of(ppo, options):
    """Return TorchRL's loss of copies of the networks."""
    coefficient = options.get("entropy", 0.0)
    return ClipPPOLoss(
        copy.deepcopy(ppo.policy),
        copy.deepcopy(ppo.critic),
        clip_epsilon=options.get("clip", 0.2),
        normalize_advantage=True,
        entropy_bonus=coefficient > 0,
        entropy_coeff=coefficient,
        critic_coeff=0.5,
        loss_critic_type="l2",
        functional=False,
    )


def gradient_of(loss, *networks):
    parameters = [each for network in networks for each in network.parameters()]
    found = torch.autograd.grad(loss, parameters, allow_unused=True)
    return torch.cat([each.flatten() for each in found if each is not None])


@pytest.mark.fast(3)
@pytest.mark.parametrize(("make_env", "options"), KINDS)
def test_losses_and_gradients_are_those_of_torchrl(make_env, options):
    torch.manual_seed(0)
    env = make_env()
    ppo = PPO(env, minibatches=3, epochs=2, compile=False, **options)
    rollout = Rollout(env, ppo.policy, 27, ppo.keys)
    for progress in (0.0, 0.5):  # then the policy has moved, and statistics are known
        batch = rollout.collect()
        rows, weights = ppo.prepare(batch.clone(), progress), ppo.loss_weights(progress)
        rows["action_log_prob"] += 0.3 * torch.randn_like(rows["action_log_prob"])
        losses, reference = ppo.losses(rows), reference_of(ppo, options)
        data = TensorDict(dict(rows), len(rows["advantage"])).set(ppo.sample_key, rows["action"])
        expected = dict(reference(data).items())
        for name in expected.keys() & {"loss_objective", "loss_critic", "entropy"}:
            torch.testing.assert_close(losses[name], expected[name].mean(), rtol=1e-5, atol=1e-6)
        found = gradient_of(
            sum(weight * losses[name] for name, weight in weights.items()), ppo.policy, ppo.critic
        )
        theirs = gradient_of(
            sum(each for name, each in expected.items() if name.startswith("loss_")),
            reference.actor_network,
            reference.critic_network,
        )
        torch.testing.assert_close(found, theirs, rtol=1e-4, atol=1e-5)
        report = ppo.report([{name: each.detach() for name, each in losses.items()}], weights)
        for name in expected.keys() & {"clip_fraction", "kl_approx", "max_ratio", "mean_ratio"}:
            assert report[name] == pytest.approx(float(expected[name]), rel=1e-3, abs=1e-5)
        ppo.update(batch, progress)
