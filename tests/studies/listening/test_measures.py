import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictSequential
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from worlds import acting, cones

from coil_rl.learners import PPO
from coil_studies.listening.measures import (
    InterceptedPolicy,
    agreement,
    gradient,
    intervention,
    split_policy,
)


def random_states(count=500, guides=2, size=1):
    torch.manual_seed(0)
    advice = torch.rand(count, guides, size) * 2 - 1
    return TensorDict({"observation": torch.randn(count, 3), "guide_action": advice}, [count])


def follow_first(states):
    return states["guide_action"][:, 0]


def test_follower_of_the_first_guide_uses_only_that_one():
    states = random_states()
    distance = (states["guide_action"][:, 0] - states["guide_action"][:, 1]).abs().squeeze(-1)
    expected = torch.stack([torch.zeros_like(distance), distance], 1)
    assert torch.equal(agreement(follow_first, states), expected)
    generator = torch.Generator().manual_seed(0)
    change = intervention(follow_first, states, donors=64, generator=generator)
    assert (change[:, 1] == 0).all()
    # The mean distance of two independent draws from [-1, 1] is 2/3.
    assert change[:, 0].mean() == pytest.approx(2 / 3, abs=0.04)
    assert gradient(follow_first, states).unique(dim=0).tolist() == [[1.0, 0.0]]


def test_agreement_by_coincidence_is_no_use_of_advice():
    states = random_states()
    states["guide_action"][:, 0] = states["observation"][:, :1]
    network = nn.Linear(3, 1)
    nn.init.zeros_(network.bias)
    network.weight.data = torch.tensor([[1.0, 0.0, 0.0]])

    def act(states):
        return network(states["observation"])

    assert (agreement(act, states)[:, 0] == 0).all()
    assert (intervention(act, states) == 0).all()
    assert (gradient(act, states) == 0).all()


def test_gradient_equals_finite_differences():
    states = random_states(50, guides=3, size=2).double()
    network = nn.Sequential(nn.Linear(9, 16), nn.Tanh(), nn.Linear(16, 2)).double()

    def act(states):
        return network(torch.cat([states["observation"], states["guide_action"].flatten(1)], -1))

    found, step = gradient(act, states), 1e-6
    for guide in range(3):
        squares = torch.zeros(50, dtype=torch.float64)
        for axis in range(2):
            above, below = states.clone(), states.clone()
            above["guide_action"][:, guide, axis] += step
            below["guide_action"][:, guide, axis] -= step
            squares += ((act(above) - act(below)).detach() / (2 * step)).square().sum(-1)
        torch.testing.assert_close(found[:, guide], squares.sqrt(), rtol=1e-6, atol=1e-8)


def test_interventions_are_seeded_and_do_not_change_the_states():
    states, before = random_states(), random_states()
    runs = [
        intervention(follow_first, states, 4, torch.Generator().manual_seed(seed))
        for seed in (1, 1, 2)
    ]
    assert (runs[0] == runs[1]).all()
    assert (runs[0] != runs[2]).any()
    gradient(
        lambda states: states.set("more", states["guide_action"])["guide_action"][:, 0], states
    )
    assert set(states.keys()) == set(before.keys())
    assert (states == before).all()


def double(state):
    return state.set("guide_action", state["guide_action"] * 2)


def test_intercepted_policy_acts_on_changed_advice_and_leaves_that_of_the_env():
    follow = acting(lambda advice: advice[:, 0], "guide_action")
    state = cones().reset()
    advice = state["guide_action"].clone()
    acted = InterceptedPolicy(follow, double)(state)
    assert (acted["action"] == 2 * advice[:, 0]).all()
    assert (acted["guide_action"] == advice).all()


@pytest.mark.parametrize("mode", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
def test_advice_of_the_first_module_of_a_policy_is_intercepted(mode):
    env = cones()
    actor = PPO(env, ["observation", "guide_action"], action_gain=1.0).policy
    advise = acting(lambda seen: seen[:, None, :1], "observation", out="guide_action")
    dynamic = ProbabilisticTensorDictSequential(advise, *actor.module)
    state = env.reset().exclude("guide_action")
    actions = []
    for act in (
        InterceptedPolicy(dynamic, double),
        InterceptedPolicy(TensorDictSequential(advise, actor), double),
        lambda state: actor(double(advise(state))),
    ):
        torch.manual_seed(1)
        with set_exploration_type(mode):
            actions.append(act(state.clone())["action"])
    assert (actions[0] == actions[2]).all()
    assert (actions[1] == actions[2]).all()
    assert split_policy(dynamic)[0] is advise
    with pytest.raises(ValueError, match="does not read guide_action; it reads observation"):
        split_policy(PPO(env, ["observation"]).policy)
