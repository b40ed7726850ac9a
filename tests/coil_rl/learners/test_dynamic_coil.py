from copy import deepcopy
from functools import partial

import pytest
import torch
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.learners import AfterFrames, AtConvergence, DynamicCoil, PhaseSchedule, networks
from coil_rl.learners.encoders import Mlp, ObservationNetwork
from coil_rl.run.rollout import Rollout

AGENT = (True, ())


def schedule(guides=3, **options):
    return PhaseSchedule(
        guides, agent_phase=AfterFrames(20), guide_phase=AfterFrames(10), **options
    )


def phases(schedule, updates, frames=10):
    """The learning networks in each update, as (agent, guides)."""
    result = []
    for _ in range(updates):
        result.append((schedule.phase.agent, schedule.phase.guides))
        schedule.advance(frames, reward=0.0)
    return result


def test_agent_and_guides_alternate_and_the_ith_guide_phase_is_of_guide_i_mod_n():
    assert phases(schedule(), 8) == [
        AGENT,
        AGENT,
        (False, (0,)),
        AGENT,
        AGENT,
        (False, (1,)),
        AGENT,
        AGENT,
    ]
    assert [guides[0] for agent, guides in phases(schedule(), 24) if not agent] == [
        0,
        1,
        2,
        0,
        1,
        2,
        0,
        1,
    ]
    assert set(phases(schedule(2, order="joint"), 9)) == {(True, (0, 1))}
    assert set(phases(schedule(2, order="agent"), 9)) == {AGENT}
    assert phases(schedule(2, order="guide"), 4) == [
        (False, (0,)),
        (False, (1,)),
        (False, (0,)),
        (False, (1,)),
    ]


def test_stochastic_choice_is_uniform_and_follows_from_the_seed():
    def guides(seed):
        return [
            guides[0]
            for _, guides in phases(schedule(order="guide", choice="stochastic", seed=seed), 300)
        ]

    assert guides(1) == guides(1) != guides(2)
    assert all(70 < guides(1).count(guide) < 130 for guide in range(3))


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
    assert [order.advance(1, reward) for reward in (1, 2, 1.5, 1, 0.5)] == [
        False,
        False,
        True,
        False,
        True,
    ]


def cars():
    return TransformedEnv(ConeTrackEnv(shipped_tracks("test")[:1], 16, rate=6), RewardSum())


def guide(env):
    network = ObservationNetwork(env, ["observation"], Mlp([8]), 1, 1.0)
    return networks.FastTensorDictModule(network, ["observation"], ["action"])


def make(env, guides=("left", "right"), frames=512, seed=0, **options):
    torch.manual_seed(seed)
    stop = AfterFrames(frames)
    phases = partial(PhaseSchedule, agent_phase=stop, guide_phase=stop, **options.pop("phases", {}))
    return DynamicCoil(
        env,
        guides={name: guide(env) for name in guides},
        phases=phases,
        **{
            "minibatches": 4,
            "epochs": 2,
            "hidden": [16],
            "action_gain": 1.0,
            "learning_rate": 1e-3,
            "guide_learning_rate": 1e-3,
        }
        | options,
    )


def weights(learner):
    """A copy of the parameters of each group: agent, critic, guides."""
    return [[p.detach().clone() for p in group] for group in learner.parameter_groups()]


def changed(before, after):
    pairs = zip(before, after, strict=True)
    return [not all(torch.equal(a, b) for a, b in zip(*groups, strict=True)) for groups in pairs]


def updates(learner, env, count):
    """The groups that each update changed, and its metrics."""
    rollout, result = Rollout(env, learner.policy, 32, [*learner.keys]), []
    for number in range(count):
        before = weights(learner)
        metrics = learner.update(rollout.collect(), number / count)
        result.append((changed(before, weights(learner)), metrics))
    return result


@pytest.mark.slow
def test_each_phase_changes_its_networks_only_and_at_a_smaller_rate_than_the_last_of_its_kind():
    result = updates(make(env := cars(), shrink=0.5, epochs=1), env, 4)
    agent_phase, first, second = (
        [True, True, False, False],
        [False, True, True, False],
        [False, True, False, True],
    )
    assert [groups for groups, _ in result] == [agent_phase, first, agent_phase, second]
    assert [metrics["guide"] for _, metrics in result] == [-1, 0, -1, 1]
    assert [metrics["guides_changed"] for _, metrics in result] == [0, 1, 0, 1]
    assert [metrics["learning_rate"] for _, metrics in result] == [1e-3, 0, 5e-4, 0]
    assert [metrics["guide_learning_rate"] for _, metrics in result] == [0, 1e-3, 0, 5e-4]


@pytest.mark.slow
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
    ((changed_groups, metrics),) = updates(make(env := cars(), **options), env, 1)
    assert changed_groups == groups
    assert (metrics["moved_left"] > 0) == groups[2]
    assert (metrics["moved_right"] > 0) == groups[3]


def test_dynamic_coil_with_frozen_guides_is_coil():
    """The agent acts on the observation and the actions of the guides, as with `GuideActions`."""
    env = cars()
    learner = make(env, phases={"order": "agent"})
    batch = Rollout(env, learner.policy, 8).collect()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        advice = torch.stack(
            [guide(batch.select("observation"))["action"] for guide in learner.guides.values()], 2
        )
        torch.testing.assert_close(batch["guide_action"], advice)
        observed = batch.select("observation").set("guide_action", advice)
        assert torch.equal(
            learner.policy(batch.select("observation"))["loc"], learner.policy[1](observed)["loc"]
        )


@pytest.mark.slow
def test_state_resumes_in_the_middle_of_a_phase():
    env, first = cars(), make(cars(), frames=1024)
    batches = [Rollout(env, first.policy, 32, [*first.keys]).collect() for _ in range(5)]
    for batch in batches[:3]:
        first.update(batch.clone())
    second = make(cars(), frames=1024, seed=5)
    second.initial = first.initial
    second.load_state_dict(deepcopy(first.state_dict()))
    for batch in batches[3:]:
        assert first.update(batch.clone()) == second.update(batch.clone())
    assert changed(weights(first), weights(second)) == [False] * 4


@pytest.mark.slow
def test_guide_learns_to_steer_through_a_frozen_agent():
    """Steering left is rewarded. The guide can change it only through its advice to the agent."""
    env = cars()
    learner = make(
        env,
        guides=("only",),
        phases={"order": "guide"},
        gamma=0.0,
        epochs=8,
        guide_learning_rate=3e-3,
    )
    rollout = Rollout(env, learner.policy, 32, [*learner.keys])
    observed = rollout.collect().select("observation")

    def steering():
        return float(learner.policy.get_dist(observed.copy()).deterministic_sample.detach().mean())

    before = steering()
    for _ in range(3):
        batch = rollout.collect()
        batch["next", "reward"] = batch["action"].clone()
        learner.update(batch)
    assert steering() > before + 0.02
