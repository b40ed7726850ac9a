from copy import deepcopy
from functools import partial

import pytest
import torch
from any_env import AnyEnv, check_same_update
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.learners import AfterFrames, AtConvergence, DynamicCoil, PhaseSchedule, networks
from coil_rl.learners.encoders import Mlp, ObservationNetwork
from coil_rl.run.rollout import Rollout


def schedule(guides=3, **options):
    return PhaseSchedule(
        guides, agent_phase=AfterFrames(20), guide_phase=AfterFrames(10), **options
    )


def phases(schedule, updates):
    """Return what learns in each update of 10 frames: "A" the agent, a number a guide."""
    result = []
    for _ in range(updates):
        result.append("A" * schedule.phase.agent + "".join(map(str, schedule.phase.guides)))
        schedule.advance(10, reward=0.0)
    return result


def test_agent_and_guides_alternate_and_the_ith_guide_phase_is_of_guide_i_mod_n():
    assert phases(schedule(), 15) == [*"AA0AA1AA2AA0AA1"]
    assert phases(schedule(2, order="joint"), 3) == ["A01"] * 3
    assert phases(schedule(2, order="agent"), 5) == [*"AAAAA"]
    assert phases(schedule(2, order="guide"), 4) == [*"0101"]


def test_stochastic_choice_is_uniform_and_follows_from_the_seed():
    first, same, other = (
        phases(schedule(order="guide", choice="stochastic", seed=seed), 300) for seed in (1, 1, 2)
    )
    assert first == same != other
    assert all(70 < first.count(guide) < 130 for guide in "012")


@pytest.mark.parametrize("choice", ["sequential", "stochastic"])
def test_schedule_resumes_in_the_middle_of_a_phase(choice):
    whole, first, second = (schedule(choice=choice, seed=seed) for seed in (0, 0, 9))
    before = phases(first, 25)
    second.load_state_dict(first.state_dict())
    assert before + phases(second, 35) == phases(whole, 60)


def test_convergence_is_several_evaluations_without_improvement_within_a_phase():
    stop = AtConvergence(evaluations=2, improvement=0.1)
    assert not stop(100, [1.0, 2.0, 1.9])
    assert stop(100, [1.0, 2.0, 1.9, 2.05])
    assert not stop(100, [1.0, 2.0, 1.9, 2.2])
    assert not stop(100, [])
    assert AtConvergence(evaluations=5, frames=100)(100, [1.0])
    order = PhaseSchedule(1, agent_phase=AtConvergence(1), guide_phase=AtConvergence(1))
    ends = [order.advance(1, reward) for reward in (1, 2, 1.5, 1, 0.5)]
    assert ends == [False, False, True, False, True]


def guide(env):
    network = ObservationNetwork(env, ["observation"], Mlp([8]), 1, 1.0)
    return networks.FastTensorDictModule(network, ["observation"], ["action"])


SMALL = {
    "minibatches": 4,
    "epochs": 2,
    "hidden": [16],
    "action_gain": 1.0,
    "learning_rate": 1e-3,
    "guide_learning_rate": 1e-3,
}


def make(guides=("left", "right"), frames=512, seed=0, phases=(), **options):
    """A learner and its rollouts, of 512 frames."""
    torch.manual_seed(seed)
    env, stop = AnyEnv(16, Bounded(-1, 1, (1,))), AfterFrames(frames)
    learner = DynamicCoil(
        env,
        guides={name: guide(env) for name in guides},
        phases=partial(PhaseSchedule, agent_phase=stop, guide_phase=stop, **dict(phases)),
        **SMALL | options,
    )
    return learner, Rollout(env, learner.policy, 32, learner.keys)


def weights(learner):
    """A copy of the parameters of each group: agent, critic, guides."""
    return [[p.detach().clone() for p in group] for group in learner.parameter_groups()]


def changed(before, after):
    pairs = zip(before, after, strict=True)
    return [not all(torch.equal(a, b) for a, b in zip(*groups, strict=True)) for groups in pairs]


def updates(learner, rollout, count):
    """The groups that each update changed, and its metrics."""
    result = []
    for number in range(count):
        before = weights(learner)
        metrics = learner.update(rollout.collect(), number / count)
        result.append((changed(before, weights(learner)), metrics))
    return result


@pytest.mark.slow
def test_each_phase_changes_its_networks_only_and_at_a_smaller_rate_than_the_last_of_its_kind():
    result = updates(*make(shrink=0.5, epochs=1), 4)
    agent_phase, first = [True, True, False, False], [False, True, True, False]
    second = [False, True, False, True]
    assert [groups for groups, _ in result] == [agent_phase, first, agent_phase, second]
    assert [metrics["guide"] for _, metrics in result] == [-1, 0, -1, 1]
    assert [metrics["guides_changed"] for _, metrics in result] == [0, 1, 0, 1]
    assert [metrics["learning_rate"] for _, metrics in result] == [1e-3, 0, 5e-4, 0]
    assert [metrics["guide_learning_rate"] for _, metrics in result] == [0, 1e-3, 0, 5e-4]


@pytest.mark.parametrize(
    ("options", "groups"),
    [
        ({"phases": {"order": "joint"}}, [True, True, True, True]),
        ({"phases": {"order": "agent"}}, [True, True, False, False]),
        ({"phases": {"order": "guide"}}, [False, True, True, False]),
        ({"critic_phases": "agent"}, [True, True, False, False]),
        ({"critic_phases": "guide"}, [True, False, False, False]),
    ],
)
def test_orders_and_phases_of_the_critic_change_their_networks_only(options, groups):
    ((changed_groups, metrics),) = updates(*make(**options), 1)
    assert changed_groups == groups
    assert (metrics["moved_left"] > 0) == groups[2]
    assert (metrics["moved_right"] > 0) == groups[3]


def test_dynamic_coil_with_frozen_guides_is_coil():
    """The agent acts on the observation and the actions of the guides, as with `GuideActions`."""
    learner, rollout = make(phases={"order": "agent"})
    batch = rollout.collect()
    observed = batch.select("observation")
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        actions = [guide(observed.copy())["action"] for guide in learner.guides.values()]
        advice = torch.stack(actions, 2)
        torch.testing.assert_close(learner.policy(observed.copy())["guide_action"], advice)
        expected = learner.policy[1](observed.copy().set("guide_action", advice))
        assert torch.equal(learner.policy(observed.copy())["loc"], expected["loc"])


@pytest.mark.slow
def test_state_resumes_in_the_middle_of_a_phase():
    first, rollout = make(frames=1024)
    for _ in range(3):
        first.update(rollout.collect())
    second, _ = make(frames=1024, seed=5)
    second.initial = first.initial
    second.load_state_dict(deepcopy(first.state_dict()))
    for _ in range(2):
        check_same_update(first, second, rollout.collect())
    assert changed(weights(first), weights(second)) == [False] * 4


@pytest.mark.slow
def test_guide_learns_to_steer_through_a_frozen_agent():
    """A large action is rewarded. The guide can change it only through its advice to the agent."""
    options = {"gamma": 0.0, "epochs": 8, "guide_learning_rate": 3e-3}
    learner, rollout = make(guides=("only",), phases={"order": "guide"}, **options)
    observed = rollout.collect().select("observation")

    def action():
        return float(learner.policy.get_dist(observed.copy()).mode.detach().mean())

    before = action()
    for _ in range(3):
        batch = rollout.collect()
        batch["next", "reward"] = batch["action"].clone()
        learner.update(batch)
    assert action() > before + 0.02
