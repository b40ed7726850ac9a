import pytest
import torch
import worlds
from torchrl.envs import RewardScaling, RewardSum

from coil_rl.schedules import Linear
from coil_rl.transforms import RewardCoupling, set_progress
from coil_rl.transforms.reward_coupling import TaskReward


@pytest.mark.parametrize(("norm", "order"), [("l1", 1), ("l2", 2), ("linf", torch.inf)])
def test_reward_is_the_task_reward_minus_beta_times_the_distance(norm, order):
    env = worlds.cones(RewardCoupling(0.3, norm))
    env.transform.insert(0, RewardSum())
    rollout = env.train().rollout(30, break_when_any_done=False)
    after = rollout["next"]
    distance = torch.linalg.vector_norm(
        rollout["action"] - rollout["guide_action"][..., 0, :], order, -1, True
    )
    assert torch.equal(after["guide_distance"], distance)
    assert torch.equal(after["reward"], after["task_reward"] - 0.3 * distance)
    assert (distance > 0.01).any()
    torch.testing.assert_close(after["episode_reward"][:, 2], after["task_reward"][:, :3].sum(1))


def test_beta_follows_its_schedule_in_training_and_is_zero_in_evaluation():
    env = worlds.cones(RewardCoupling(Linear(1.0, 0.5))).train()
    for progress in (0.0, 0.5, 1.0):
        set_progress(env, progress)
        after = env.rollout(3)["next"]
        distance = (1 - progress / 2) * after["guide_distance"]
        torch.testing.assert_close(after["task_reward"] - after["reward"], distance)
    after = env.eval().rollout(3)["next"]
    assert torch.equal(after["reward"], after["task_reward"])
    assert (after["guide_distance"] > 0).any()


def test_distance_of_discrete_actions_is_0_or_2():
    rollout = worlds.carts(RewardCoupling(0.5, "l1")).train().rollout(5)
    differs = rollout["action"] != rollout["guide_action"].argmax(-1).squeeze(-1)
    assert torch.equal(rollout["next", "guide_distance"].squeeze(-1), 2.0 * differs)


def test_kept_reward_stays_the_envs_own_behind_a_transform_of_the_reward():
    parts = [TaskReward(), RewardScaling(0.0, 0.5), RewardCoupling(beta=0.3)]
    after = worlds.cones(*parts).train().rollout(3)["next"]
    coupled = 0.5 * after["task_reward"] - 0.3 * after["guide_distance"]
    torch.testing.assert_close(after["reward"], coupled)
