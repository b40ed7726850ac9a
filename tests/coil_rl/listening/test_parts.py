import pytest
import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictSequential
from torchrl.envs.utils import ExplorationType, set_exploration_type
from worlds import cones

from coil_rl.learners import PPO
from coil_rl.listening import Intercepted, split


def double(seen):
    return seen.set("guide_action", seen["guide_action"] * 2)


def test_nothing_done_in_between_changes_nothing():
    env = cones()
    policy, seen = PPO(env, ["observation", "guide_action"], action_gain=1.0).policy, env.reset()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        plain = policy(seen.clone())
        same = Intercepted(policy, lambda seen: seen)(seen.clone())
    assert (plain == same).all()


def test_the_agent_acts_on_what_came_out_and_the_env_keeps_what_went_in():
    follow = TensorDictModule(lambda advice: advice[:, 0], in_keys=["guide_action"], out_keys=["action"])
    seen = cones().reset()
    said = seen["guide_action"].clone()
    acted = Intercepted(follow, double)(seen)
    assert (acted["action"] == 2 * said[:, 0]).all()
    assert (acted["guide_action"] == said).all()


@pytest.mark.parametrize("sampled", [False, True])
def test_advice_worked_out_by_the_policy_is_intercepted_as_well(sampled):
    env = cones()
    actor = PPO(env, ["observation", "guide_action"], action_gain=1.0).policy
    advise = TensorDictModule(lambda seen: seen[:, None, :1], in_keys=["observation"], out_keys=["guide_action"])
    dynamic = ProbabilisticTensorDictSequential(advise, *actor.module)
    static = TensorDictSequential(advise, actor)
    seen = env.reset().exclude("guide_action")
    mode = ExplorationType.RANDOM if sampled else ExplorationType.DETERMINISTIC
    actions = []
    for policy in (dynamic, static):
        torch.manual_seed(1)
        with set_exploration_type(mode):
            actions.append(Intercepted(policy, double)(seen.clone())["action"])
    torch.manual_seed(1)
    with set_exploration_type(mode):
        wanted = actor(double(advise(seen.clone())))["action"]
    assert all((action == wanted).all() for action in actions)
    advising, acting = split(dynamic)
    assert advising is advise
    assert "guide_action" in acting.in_keys


def test_a_policy_that_sees_no_advice_is_refused():
    env = cones()
    with pytest.raises(ValueError, match="does not read guide_action; it reads observation"):
        split(PPO(env, ["observation"]).policy)
