import torch
from torchrl.objectives.value import GAE

from coil_rl.envs import ConeTrackEnv
from coil_rl.guides import RandomGuide
from coil_rl.learners.advantages import Advantages
from coil_rl.learners.networks import critic
from coil_rl.train.rollout import Rollout


def batch_with_every_end(ring):
    env = ConeTrackEnv([ring], 16, time_limit=1.8)
    batch = Rollout(env, RandomGuide(-1, 1), 120).collect()
    done, terminated = batch["next", "done"], batch["next", "terminated"]
    assert terminated.any()
    assert (done & ~terminated).any()
    return env, batch


def test_advantages_are_those_of_a_critic_that_looks_at_every_state_twice(ring):
    torch.manual_seed(0)
    env, batch = batch_with_every_end(ring)
    values = critic(env, ["observation"])
    ours = Advantages(values, 0.98, 0.9)(batch.clone())
    with torch.no_grad():
        truth = GAE(gamma=0.98, lmbda=0.9, value_network=values)(batch.clone())
    for key in ("advantage", "value_target", "state_value"):
        torch.testing.assert_close(ours[key], truth[key], rtol=1e-5, atol=1e-5)


def test_a_batch_without_any_end_is_no_exception(ring):
    env = ConeTrackEnv([ring], 4)
    batch = Rollout(env, RandomGuide(0, 0), 3).collect()
    assert not batch["next", "done"].any()
    assert Advantages(critic(env, ["observation"]), 0.99, 0.95)(batch)["advantage"].shape == (4, 3, 1)
