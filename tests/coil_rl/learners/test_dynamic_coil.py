import math
from copy import deepcopy
from functools import partial

import pytest
import torch
import worlds
from tensordict.nn import TensorDictModule
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.learners import AfterFrames, AtConvergence, DynamicCoil, PhaseSchedule, networks
from coil_rl.train.rollout import Rollout

AGENT = (True, ())


def schedule(guides=3, **options):
    return PhaseSchedule(guides, agent_phase=AfterFrames(20), guide_phase=AfterFrames(10), **options)


def phases(schedule, updates, frames=10):
    """The learning networks in each update, as (agent, guides)."""
    result = []
    for _ in range(updates):
        result.append((schedule.phase.agent, schedule.phase.guides))
        schedule.advance(frames, reward=0.0)
    return result


def test_agent_and_guides_alternate_and_the_ith_guide_phase_is_of_guide_i_mod_n():
    assert phases(schedule(), 8) == [AGENT, AGENT, (False, (0,)), AGENT, AGENT, (False, (1,)), AGENT, AGENT]
    assert [guides[0] for agent, guides in phases(schedule(), 24) if not agent] == [0, 1, 2, 0, 1, 2, 0, 1]


def test_stochastic_choice_is_uniform_and_follows_from_the_seed():
    def guides(seed):
        return [guides[0] for _, guides in phases(schedule(order="guide", choice="stochastic", seed=seed), 300)]

    assert guides(1) == guides(1) != guides(2)
    assert all(70 < guides(1).count(guide) < 130 for guide in range(3))


def test_control_orders_have_one_kind_of_phase():
    assert set(phases(schedule(2, order="joint"), 9)) == {(True, (0, 1))}
    assert set(phases(schedule(2, order="agent"), 9)) == {AGENT}
    assert phases(schedule(2, order="guide"), 4) == [(False, (0,)), (False, (1,)), (False, (0,)), (False, (1,))]


def test_earlier_phases_are_counted_by_kind():
    order, earlier = schedule(), []
    for _ in range(9):
        earlier.append(order.phase.earlier)
        order.advance(20, reward=0.0)
    assert earlier == [0, 0, 1, 1, 2, 2, 3, 3, 4]


@pytest.mark.parametrize("choice", ["sequential", "stochastic"])
def test_schedule_resumes_in_the_middle_of_a_phase(choice):
    whole, first, second = (schedule(choice=choice, seed=seed) for seed in (0, 0, 9))
    before = phases(first, 25)
    second.load_state_dict(first.state_dict())
    assert before + phases(second, 35) == phases(whole, 60)


def test_convergence_is_several_evaluations_without_improvement():
    stop = AtConvergence(evaluations=2, improvement=0.1)
    assert not stop(100, [1.0, 2.0, 1.9])
    assert stop(100, [1.0, 2.0, 1.9, 2.05])
    assert not stop(100, [1.0, 2.0, 1.9, 2.2])
    assert not stop(100, [])
    assert AtConvergence(evaluations=5, frames=100)(100, [1.0])


def test_rewards_of_earlier_phases_do_not_count_for_convergence():
    order = PhaseSchedule(1, agent_phase=AtConvergence(1), guide_phase=AtConvergence(1))
    ended = [order.advance(1, reward) for reward in (1, 2, 1.5, 1, 0.5)]
    assert ended == [False, False, True, False, True]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PhaseSchedule(0), "guides=0 must be at least 1"),
        (lambda: PhaseSchedule(2, order="both"), "order='both' must be one of alternate"),
        (lambda: PhaseSchedule(2, choice="first"), "choice='first' must be one of sequential"),
        (lambda: AfterFrames(0), "frames=0 must be at least 1"),
        (lambda: AtConvergence(0), "evaluations=0 must be at least 1"),
        (lambda: AtConvergence(improvement=-1), "improvement=-1 must be at least 0"),
        (lambda: AtConvergence(frames=0), "frames=0 must be at least 1"),
    ],
)
def test_phases_out_of_range_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def cars():
    return TransformedEnv(ConeTrackEnv(shipped_tracks("test")[:1], 16, rate=6), RewardSum())


def guide(env):
    network = networks.ObservationNetwork(env, ["observation"], [8], 1, 1.0)
    return networks.FastTensorDictModule(network, ["observation"], ["action"])


def make(env, guides=("left", "right"), frames=512, seed=0, **options):
    torch.manual_seed(seed)
    stop = AfterFrames(frames)
    phases = partial(PhaseSchedule, agent_phase=stop, guide_phase=stop, **options.pop("phases", {}))
    return DynamicCoil(
        env, guides={name: guide(env) for name in guides}, phases=phases,
        **{"minibatches": 4, "epochs": 2, "hidden": [16], "action_gain": 1.0, "learning_rate": 1e-3,
           "guide_learning_rate": 1e-3} | options,
    )  # fmt: skip


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


def test_each_phase_changes_its_networks_only():
    result = updates(make(env := cars()), env, 4)
    agent_phase, first, second = [True, True, False, False], [False, True, True, False], [False, True, False, True]
    assert [groups for groups, _ in result] == [agent_phase, first, agent_phase, second]
    assert [metrics["guide"] for _, metrics in result] == [-1, 0, -1, 1]
    assert [metrics["guides_changed"] for _, metrics in result] == [0, 1, 0, 1]


@pytest.mark.parametrize(("critic_phases", "learns"), [("agent", [True, False]), ("guide", [False, True])])
def test_critic_learns_in_its_phases(critic_phases, learns):
    result = updates(make(env := cars(), critic_phases=critic_phases), env, 2)
    assert [groups[1] for groups, _ in result] == learns


@pytest.mark.parametrize(
    ("order", "groups"),
    [("joint", [True, True, True, True]), ("agent", [True, True, False, False]), ("guide", [False, True, True, False])],
)
def test_control_orders_change_their_networks_only(order, groups):
    assert updates(make(env := cars(), phases={"order": order}), env, 1)[0][0] == groups


def test_learning_rates_shrink_from_each_phase_to_the_next_of_its_kind():
    result = updates(make(env := cars(), shrink=0.5), env, 6)
    assert [metrics["learning_rate"] for _, metrics in result] == [1e-3, 0, 5e-4, 0, 2.5e-4, 0]
    assert [metrics["guide_learning_rate"] for _, metrics in result] == [0, 1e-3, 0, 5e-4, 0, 2.5e-4]


def test_moved_is_the_change_of_the_action_of_a_guide():
    (_, first), (_, second) = updates(make(env := cars(), phases={"order": "guide"}), env, 2)
    assert first["moved_left"] > 0
    assert first["moved_right"] == 0 < second["moved_right"]


def test_dynamic_coil_with_frozen_guides_is_coil():
    """The agent acts on the observation and the actions of the guides, as with `GuideActions`."""
    env = cars()
    learner = make(env, phases={"order": "agent"})
    batch = Rollout(env, learner.policy, 8).collect()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        advice = torch.stack([guide(batch.select("observation"))["action"] for guide in learner.guides.values()], 2)
        torch.testing.assert_close(batch["guide_action"], advice)
        observed = batch.select("observation").set("guide_action", advice)
        assert torch.equal(learner.policy(batch.select("observation"))["loc"], learner.policy[1](observed)["loc"])


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


def test_unusable_guides_and_values_out_of_range_are_refused():
    env = cars()
    one = guide(env)
    constant = TensorDictModule(lambda observation: observation[..., :1] * 0, ["observation"], ["action"])
    with pytest.raises(ValueError, match="guide 'constant' has no parameters"):
        DynamicCoil(env, guides={"constant": constant})
    with pytest.raises(ValueError, match="two guides share parameters"):
        DynamicCoil(env, guides={"one": one, "two": one})
    with pytest.raises(ValueError, match="Dynamic COIL needs continuous actions"):
        DynamicCoil(worlds.carts(), guides={"one": one})
    for name, value in (("shrink", 0), ("critic_phases", "never"), ("guide_learning_rate", math.nan)):
        with pytest.raises(ValueError, match=f"{name}=.* must be"):
            DynamicCoil(env, guides={"one": one}, **{name: value})


def test_guide_learns_to_steer_through_a_frozen_agent():
    """Steering left is rewarded. The guide can change it only through its advice to the agent."""
    env = cars()
    learner = make(env, guides=("only",), phases={"order": "guide"}, gamma=0.0, epochs=8)
    rollout = Rollout(env, learner.policy, 32, [*learner.keys])
    observed = rollout.collect().select("observation")

    def steering():
        return float(learner.policy.get_dist(observed.copy()).deterministic_sample.detach().mean())

    before = steering()
    for _ in range(8):
        batch = rollout.collect()
        batch["next", "reward"] = batch["action"].clone()
        learner.update(batch)
    assert steering() > before + 0.02
