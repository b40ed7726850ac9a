"""Properties of all on-policy learners."""

from functools import partial

import pytest
import torch
import worlds
from any_env import AnyEnv, learning
from cart_poles import CartPoles
from torchrl.data import Unbounded
from torchrl.objectives.value import GAE

from coil_rl.envs import ConeTrackEnv
from coil_rl.guides import RandomGuide
from coil_rl.learners import A2C, PPO, TRPO, Reinforce
from coil_rl.learners.batches import add_advantages
from coil_rl.learners.networks import critic
from coil_rl.learners.policy import Entries
from coil_rl.run.rollout import Rollout
from coil_rl.schedules import Linear
from coil_rl.transforms import JumpStart, Takeover

LEARNERS = [PPO, A2C, TRPO, Reinforce]


def weights(learner):
    return torch.cat(
        [p.detach().flatten() for net in (learner.policy, learner.critic) for p in net.parameters()]
    )


def trained(kind, env, updates=2, steps=8, **options):
    """A learner after some updates."""
    torch.manual_seed(0)
    learner = kind(env, **{"minibatches": 2} | options)
    rollout = Rollout(env, learner.policy, steps, learner.keys)
    for number in range(updates):
        learner.update(rollout.collect(), number / updates)
    return learner


@pytest.mark.slow
@pytest.mark.parametrize("kind", LEARNERS)
@pytest.mark.parametrize("make", [partial(JumpStart, 0, random=True), partial(Takeover, 0.0)])
def test_guide_that_never_acts_changes_no_bit(kind, make):
    plain, shared = (trained(kind, worlds.cones(*transforms)) for transforms in ([], [make()]))
    assert torch.equal(weights(plain), weights(shared))


def test_policy_loss_depends_on_the_steps_of_the_agent_only():
    torch.manual_seed(0)
    env = worlds.cones(Takeover(0.5))
    ppo = PPO(env)
    rows = ppo.prepare(Rollout(env, ppo.policy, 16, ppo.keys).collect(), 0.0)
    other = Entries({key: each.clone() for key, each in rows.items()})
    of_guide = ~rows["agent_acts"].squeeze(-1)
    other["advantage"][of_guide] = 1e6
    other["action_log_prob"][of_guide] = -1e6
    other["value_target"][of_guide] += 1
    losses, changed = ppo.all_losses(rows), ppo.all_losses(other)
    assert torch.equal(changed["loss_objective"], losses["loss_objective"])
    assert not torch.equal(changed["loss_critic"], losses["loss_critic"])


@pytest.mark.parametrize("kind", LEARNERS)
def test_only_the_critic_learns_from_steps_of_the_guide(kind):
    initial, learner = (trained(kind, worlds.cones(Takeover(1.0)), updates) for updates in (0, 1))
    for name, changes in [("policy", False), ("critic", True)]:
        nets = [getattr(each, name).parameters() for each in (initial, learner)]
        assert all(torch.equal(old, new) != changes for old, new in zip(*nets, strict=True))


@pytest.mark.parametrize("kind", LEARNERS)
def test_minibatch_of_one_frame_is_refused(kind):
    # The standard deviation of one advantage is NaN.
    trained(kind, CartPoles(2), steps=4, minibatches=4)
    with pytest.raises(ValueError, match="minibatches=5 leaves less than 2 of 8 frames to each"):
        trained(kind, CartPoles(2), steps=4, minibatches=5)


class SeeingPPO(PPO):
    """A critic that observes more than the policy."""

    def build_critic(self, env, in_keys, network):
        return super().build_critic(env, [*in_keys, "hidden"], network)


@pytest.mark.parametrize("normalise", [False, True])
def test_critic_may_observe_more_than_the_policy(normalise):
    shown = {"observation": Unbounded((3,)), "hidden": Unbounded((2,))}
    learner, rollout = learning(SeeingPPO, AnyEnv(observations=shown), normalise=normalise)
    batch = rollout.collect()
    assert {"hidden", ("next", "hidden")} <= set(batch.keys(True, True))
    assert "hidden" not in learner.policy.in_keys
    values = [learner.critic(batch.clone())["state_value"]]
    values.append(learner.critic(batch.clone().set("hidden", batch["hidden"] + 1))["state_value"])
    assert not torch.equal(*values)
    assert torch.tensor(list(learner.update(batch).values())).isfinite().all()


@pytest.mark.slow
def test_advantages_equal_those_of_torchrl_with_two_evaluations_per_state(ring):
    torch.manual_seed(0)
    env = ConeTrackEnv([ring], 16, time_limit=1.8)
    batch = Rollout(env, RandomGuide(-1, 1), 120).collect()
    done, terminated = batch["next", "done"], batch["next", "terminated"]
    assert terminated.any()
    assert (done & ~terminated).any()
    values = critic(env, ["observation"])
    ours = add_advantages(batch.clone(), values, 0.98, 0.9)
    with torch.no_grad():
        expected = GAE(gamma=0.98, lmbda=0.9, value_network=values)(batch.clone())
    for key in ("advantage", "value_target", "state_value"):
        torch.testing.assert_close(ours[key], expected[key], rtol=1e-5, atol=1e-5)


def test_learning_rate_follows_its_schedule():
    env = CartPoles(8)
    learner = trained(PPO, env, updates=1, learning_rate=Linear(1e-3, 0.0))
    batch, before = Rollout(env, learner.policy, 8, learner.keys).collect(), weights(learner)
    assert learner.update(batch.clone(), 1.0)["learning_rate"] == 0
    assert torch.equal(weights(learner), before)
    assert learner.update(batch, 0.25)["learning_rate"] == pytest.approx(7.5e-4)
