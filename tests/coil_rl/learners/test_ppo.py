import pytest
import torch
import worlds
from torchrl.objectives.value import GAE

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import RandomGuide
from coil_rl.learners import PPO
from coil_rl.learners.networks import critic
from coil_rl.learners.ppo import Advantages
from coil_rl.schedules import Linear
from coil_rl.train.rollout import Rollout
from coil_rl.transforms import Takeover


def make(cars=8, **changes):
    torch.manual_seed(0)
    env = ConeTrackEnv(shipped_tracks("train"), cars)
    ppo = PPO(env, **{"epochs": 2, "minibatches": 4} | changes)
    return ppo, Rollout(env, ppo.policy, 16, ppo.keys)


def test_first_loss_is_that_of_unit_ratios():
    # Before any step the ratio is 1, so the objective is minus the mean of standardised advantages, which is 0.
    ppo, rollout = make(epochs=1, minibatches=1)
    metrics = ppo.update(rollout.collect())
    assert abs(metrics["loss_objective"]) < 1e-6
    assert metrics["clip_fraction"] == 0
    assert abs(metrics["kl_approx"]) < 1e-6


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
    ppo, rollout = make(learning_rate=Linear(1e-3, 0.0))
    assert ppo.update(rollout.collect(), 0.25)["learning_rate"] == pytest.approx(7.5e-4)
    before = [p.detach().clone() for p in ppo.parameters]
    ppo.update(rollout.collect(), 1.0)
    assert all(torch.equal(old, new) for old, new in zip(before, ppo.parameters, strict=True))


def test_policy_loss_depends_on_the_steps_of_the_agent_only():
    torch.manual_seed(0)
    env = worlds.cones(Takeover(0.5))
    ppo = PPO(env)
    rows = ppo.prepare(Rollout(env, ppo.policy, 16, ppo.keys).collect(), 0.0)
    acted = rows["agent_acts"].squeeze(-1)
    losses = ppo.masked_losses(rows)
    other = rows.clone()
    other["advantage"][~acted] = 1e6
    other["action_log_prob"][~acted] = -1e6
    assert torch.equal(ppo.masked_losses(other)["loss_objective"], losses["loss_objective"])
    other["value_target"][~acted] += 1
    assert not torch.equal(ppo.masked_losses(other)["loss_critic"], losses["loss_critic"])
