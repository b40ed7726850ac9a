import copy

import pytest
import torch
import worlds
from torchrl.envs import GymEnv, PendulumEnv

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.learners import PPO
from coil_rl.schedules import Linear
from coil_rl.train.rollout import Rollout
from coil_rl.transforms import JumpStart, Takeover


def learner(cars=8, **changes):
    torch.manual_seed(0)
    env = ConeTrackEnv(shipped_tracks("train"), cars)
    ppo = PPO(env, **{"epochs": 2, "minibatches": 4} | changes)
    return ppo, Rollout(env, ppo.policy, 16, ppo.keys)


def weights(ppo):
    return torch.cat([p.detach().flatten().clone() for p in ppo.parameters])


def test_first_loss_is_that_of_unit_ratios():
    # Before any step the ratio is 1, so the objective is minus the mean of normalised advantages, which is 0.
    ppo, rollout = learner(epochs=1, minibatches=1)
    metrics = ppo.update(rollout.collect())
    assert abs(metrics["loss_objective"]) < 1e-6
    assert metrics["clip_fraction"] == 0
    assert abs(metrics["kl_approx"]) < 1e-6


def test_truncation_bootstraps_and_termination_does_not():
    ppo, rollout = learner(gamma=0.5, gae_lambda=0.0)
    batch = rollout.collect()
    batch["next", "reward"].zero_()
    for key in ("done", "terminated"):
        batch["next", key].zero_()
    batch["next", "done"][0, -1] = True
    batch["next", "done"][1, -1] = batch["next", "terminated"][1, -1] = True
    with torch.no_grad():
        ppo.advantage(batch)
        value = ppo.critic(batch["next"][:2, -1].select("observation"))["state_value"]
    torch.testing.assert_close(batch["value_target"][:2, -1], value * torch.tensor([[0.5], [0.0]]))


def test_learning_rate_follows_its_schedule():
    ppo, rollout = learner(learning_rate=Linear(1e-3, 0.0))
    assert ppo.update(rollout.collect(), 0.25)["learning_rate"] == pytest.approx(7.5e-4)
    before = weights(ppo)
    ppo.update(rollout.collect(), 1.0)
    assert torch.equal(before, weights(ppo))


def test_state_dict_carries_everything_an_update_depends_on():
    first, rollout = learner()
    second, _ = learner(seed=5)
    first.update(rollout.collect())
    # Through memory both optimisers would share their moments; a file makes copies of its own.
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    batch = rollout.collect()
    first.update(batch.clone())
    second.update(batch.clone())
    assert torch.equal(weights(first), weights(second))


def test_entropy_bonus_keeps_the_policy_wide():
    scales = []
    for entropy in (0.0, 0.5):
        ppo, rollout = learner(entropy=entropy, learning_rate=1e-2)
        for _ in range(5):
            ppo.update(rollout.collect())
        scales.append(ppo.policy.module[0].module.log_scale.item())
    assert scales[1] > scales[0]


def test_policy_moves_towards_what_pays():
    # The cheapest evidence that the gradient points the right way: staying near 0 when that is what pays.
    torch.manual_seed(0)
    env = ConeTrackEnv(shipped_tracks("train"), 64)
    ppo = PPO(env, learning_rate=3e-3, epochs=4, minibatches=4)
    rollout = Rollout(env, ppo.policy, 16, ppo.keys)
    spread = []
    for _ in range(20):
        batch = rollout.collect()
        batch["next", "reward"].copy_(-batch["action"].square())
        spread.append(batch["action"].square().mean().item())
        ppo.update(batch)
    assert spread[-1] < 0.6 * spread[0]


@pytest.mark.slow
def test_solves_cartpole():
    torch.manual_seed(0)
    env = GymEnv("CartPole-v1")
    ppo = PPO(env, learning_rate=Linear(1e-3, 0.0), epochs=10, minibatches=8, gamma=0.98, gae_lambda=0.8)
    rollout = Rollout(env, ppo.policy, 1024, ppo.keys)
    for k in range(80):
        batch = rollout.collect()
        ppo.update(batch, k / 80)
    assert batch["next", "done"].float().mean() < 1 / 300


@pytest.mark.parametrize("name", ["epochs", "minibatches"])
def test_counts_below_one_are_refused(name):
    with pytest.raises(ValueError, match=f"{name}=0 must be at least 1"):
        PPO(PendulumEnv(), ["th"], **{name: 0})


@pytest.mark.parametrize(
    ("name", "value"),
    [("gamma", 2), ("gae_lambda", -1), ("critic", -1), ("seed", -1), ("action_scale", 0), ("clip", 0),
     ("max_grad_norm", -1), ("learning_rate", -1), ("entropy", -1)],
)  # fmt: skip
def test_numbers_outside_their_range_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name}={value} must be"):
        PPO(PendulumEnv(), ["th"], **{name: value})


def learned(transforms, progress=0.0, updates=2):
    """Weights and metrics after learning among cones with a guide."""
    torch.manual_seed(0)
    env = worlds.cones(*transforms)
    ppo = PPO(env, epochs=2, minibatches=4)
    rollout = Rollout(env, ppo.policy, 16, ppo.keys)
    metrics = [ppo.update(rollout.collect(), progress) for _ in range(updates)]
    return weights(ppo), metrics[-1]


@pytest.mark.parametrize("transform", [JumpStart(0), JumpStart(0, random=True), Takeover(0.0)])
def test_a_guide_that_never_acts_changes_nothing_to_the_bit(transform):
    (plain, _), (shared, metrics) = learned([]), learned([transform])
    assert torch.equal(plain, shared)
    assert metrics["loss_objective"] != 0


def test_steps_in_which_the_guide_acts_teach_the_critic_alone():
    torch.manual_seed(0)
    env = worlds.cones(Takeover(1.0))
    ppo = PPO(env, epochs=1, minibatches=2)
    policy, critic = ([p.clone() for p in net.parameters()] for net in (ppo.policy, ppo.critic))
    ppo.update(Rollout(env, ppo.policy, 16, ppo.keys).collect())
    assert all(torch.equal(old, new) for old, new in zip(policy, ppo.policy.parameters(), strict=True))
    assert not any(torch.equal(old, new) for old, new in zip(critic, ppo.critic.parameters(), strict=True))


def test_the_policys_loss_is_that_of_the_steps_in_which_it_acts():
    torch.manual_seed(0)
    env = worlds.cones(Takeover(0.5))
    ppo = PPO(env)
    batch = Rollout(env, ppo.policy, 16, ppo.keys).collect()
    ppo.advantage(batch)
    flat = batch.select(*ppo.learned_from).reshape(-1)
    acted = flat["agent_acts"].squeeze(-1)
    losses = ppo.shared_losses(flat)
    other = flat.clone()
    other["advantage"][~acted] = 1e6
    other["action_log_prob"][~acted] = -1e6
    assert torch.equal(ppo.shared_losses(other)["loss_objective"], losses["loss_objective"])
    other["value_target"][~acted] += 1
    assert not torch.equal(ppo.shared_losses(other)["loss_critic"], losses["loss_critic"])


def test_a_gain_of_zero_begins_with_the_action_zero():
    ppo, rollout = learner(action_gain=0.0)
    batch = rollout.collect()
    assert (ppo.policy.get_dist(batch.select("observation")).deterministic_sample == 0).all()
