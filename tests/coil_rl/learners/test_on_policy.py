"""Properties of all on-policy learners."""

import copy
from functools import partial

import pytest
import torch
import worlds
from cart_poles import CartPoles
from torchrl.objectives.value import GAE

from coil_rl.envs import ConeTrackEnv
from coil_rl.guides import RandomGuide
from coil_rl.learners import A2C, PPO, TRPO, KickstartLoss, Reinforce
from coil_rl.learners.advantages import Advantages
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
@pytest.mark.parametrize(
    ("kind", "make_env"),
    [*((kind, partial(CartPoles, 16)) for kind in LEARNERS), (PPO, partial(worlds.cones, cars=16))],
)
def test_rewarded_actions_become_more_likely(kind, make_env):
    torch.manual_seed(0)
    env = make_env()
    # With a discount above 0 it also pays to stay upright for longer.
    learner = kind(env, learning_rate=1e-2, gamma=0.0, minibatches=4)
    rollout = Rollout(env, learner.policy, 16, learner.keys)
    means = []
    for _ in range(10):
        batch = rollout.collect()
        action = batch["action"].reshape(16, 16, 1).float()
        batch["next", "reward"] = action.clone()
        means.append(action.mean())
        learner.update(batch)
    assert means[-1] > means[0] + 0.1


@pytest.mark.parametrize("kind", LEARNERS)
def test_state_contains_everything_the_next_update_depends_on(kind):
    env = CartPoles(8)
    first, second = trained(kind, env), kind(env, minibatches=2, seed=5)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    batch = Rollout(env, first.policy, 16, first.keys).collect()
    assert first.update(batch.clone(), 0.5) == second.update(batch.clone(), 0.5)
    assert torch.equal(weights(first), weights(second))


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


@pytest.mark.slow
@pytest.mark.parametrize("kind", [PPO, A2C, TRPO])
def test_large_kickstart_loss_makes_the_policy_imitate_the_guide(kind):
    torch.manual_seed(0)
    env = worlds.cones(cars=16)
    own = {
        PPO: {"minibatches": 2},
        A2C: {"learning_rate": 1e-2, "minibatches": 8},
        TRPO: {"max_kl": 0.1},
    }
    learner = kind(env, auxiliary=[KickstartLoss(100.0)], **own[kind])
    rollout = Rollout(env, learner.policy, 16, learner.keys)
    losses = [learner.update(rollout.collect())["loss_guide"] for _ in range(6)]
    assert losses[-1] < losses[0] - 0.3


@pytest.mark.slow
@pytest.mark.parametrize("kind", [PPO, A2C])
def test_entropy_bonus_keeps_the_policy_random(kind):
    def largest_probability(entropy):
        env = CartPoles(16)
        learner = trained(kind, env, updates=10, learning_rate=1e-2, entropy=entropy)
        with torch.no_grad():
            return (
                learner.policy.get_dist(env.rollout(8).select("observation"))
                .probs.max(-1)
                .values.mean()
            )

    assert largest_probability(1.0) < largest_probability(0.0)


@pytest.mark.parametrize("kind", LEARNERS)
def test_minibatch_of_one_frame_is_refused(kind):
    # The standard deviation of one advantage is NaN.
    trained(kind, CartPoles(2), steps=4, minibatches=4)
    with pytest.raises(ValueError, match="minibatches=5 leaves less than 2 of 8 frames to each"):
        trained(kind, CartPoles(2), steps=4, minibatches=5)


@pytest.mark.slow
def test_advantages_equal_those_of_torchrl_with_two_evaluations_per_state(ring):
    torch.manual_seed(0)
    env = ConeTrackEnv([ring], 16, time_limit=1.8)
    batch = Rollout(env, RandomGuide(-1, 1), 120).collect()
    done, terminated = batch["next", "done"], batch["next", "terminated"]
    assert terminated.any()
    assert (done & ~terminated).any()
    values = critic(env, ["observation"])
    ours = Advantages(values, 0.98, 0.9)(batch.clone())
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
