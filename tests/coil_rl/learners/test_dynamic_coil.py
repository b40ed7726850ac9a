from copy import deepcopy
from functools import partial

import pytest
import torch
import worlds
from tensordict.nn import TensorDictModule
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.learners import AfterFrames, DynamicCoil, Phases, networks
from coil_rl.train.rollout import Rollout


def cars():
    return TransformedEnv(ConeTrackEnv(shipped_tracks("test")[:1], 16, rate=6), RewardSum())


def guide(env):
    return networks.Keyed(networks.Network(env, ["observation"], [8], 1, 1.0), ["observation"], ["action"])


def learner(env, guides=("left", "right"), frames=512, seed=0, **options):
    torch.manual_seed(seed)
    phases = partial(
        Phases, agent_phase=AfterFrames(frames), guide_phase=AfterFrames(frames), **options.pop("phases", {})
    )
    return DynamicCoil(
        env, guides={name: guide(env) for name in guides}, phases=phases,
        **{"minibatches": 4, "epochs": 2, "hidden": [16], "action_gain": 1.0, "learning_rate": 1e-3,
           "guide_learning_rate": 1e-3} | options,
    )  # fmt: skip


def weights(of):
    """A copy of every group's numbers: the agent's, the critic's, each guide's."""
    return [[p.detach().clone() for p in group] for group in of.groups()]


def changed(before, after):
    return [
        not all(torch.equal(a, b) for a, b in zip(*groups, strict=True)) for groups in zip(before, after, strict=True)
    ]


def updates(of, env, count):
    """Which groups each update changed, and what it reported."""
    rollout, found = Rollout(env, of.policy, 32, [*of.keys]), []
    for number in range(count):
        before = weights(of)
        metrics = of.update(rollout.collect(), number / count)
        found.append((changed(before, weights(of)), metrics))
    return found


def test_in_each_phase_only_those_change_whose_turn_it_is():
    found = updates(learner(env := cars()), env, 4)
    agent_phase, first, second = [True, True, False, False], [False, True, True, False], [False, True, False, True]
    assert [groups for groups, _ in found] == [agent_phase, first, agent_phase, second]
    assert [metrics["guide"] for _, metrics in found] == [-1, 0, -1, 1]
    assert [metrics["guides_changed"] for _, metrics in found] == [0, 1, 0, 1]


@pytest.mark.parametrize(("critic", "learns"), [("agent", [True, False]), ("guide", [False, True])])
def test_the_critic_learns_in_the_phases_that_are_asked_for(critic, learns):
    found = updates(learner(env := cars(), critic_phases=critic), env, 2)
    assert [groups[1] for groups, _ in found] == learns


@pytest.mark.parametrize(
    ("order", "groups"),
    [("joint", [True, True, True, True]), ("agent", [True, True, False, False]), ("guide", [False, True, True, False])],
)
def test_controls_train_who_they_say(order, groups):
    assert updates(learner(env := cars(), phases={"order": order}), env, 1)[0][0] == groups


def test_the_gradient_of_the_loss_reaches_the_chosen_guide_only():
    of = learner(env := cars(), phases={"order": "guide"})
    of.update(Rollout(env, of.policy, 32, [*of.keys]).collect())
    sizes = [sum(float(p.grad.abs().sum()) for p in group if p.grad is not None) for group in of.groups()]
    assert sizes[2] > 0
    assert sizes[0] == sizes[3] == 0


def test_rates_shrink_from_each_phase_to_the_next_of_its_kind():
    found = updates(learner(env := cars(), shrink=0.5), env, 6)
    assert [metrics["learning_rate"] for _, metrics in found] == [1e-3, 0, 5e-4, 0, 2.5e-4, 0]
    assert [metrics["guide_learning_rate"] for _, metrics in found] == [0, 1e-3, 0, 5e-4, 0, 2.5e-4]


def test_a_guide_has_moved_by_how_much_its_action_changed():
    of = learner(env := cars(), phases={"order": "guide"})
    (_, first), (_, second) = updates(of, env, 2)
    assert first["moved_left"] > 0
    assert first["moved_right"] == 0 < second["moved_right"]


def test_with_guides_that_never_learn_it_is_coil():
    """The agent sees what the networks say and acts on that and its observation, as under `GuideActions`."""
    env = cars()
    of = learner(env, phases={"order": "agent"})
    batch = Rollout(env, of.policy, 8).collect()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        advice = torch.stack([guide(batch.select("observation"))["action"] for guide in of.guides.values()], 2)
        torch.testing.assert_close(batch["guide_action"], advice)
        seen = batch.select("observation").set("guide_action", advice)
        assert torch.equal(of.policy(batch.select("observation"))["loc"], of.policy[1](seen)["loc"])


def test_a_state_goes_on_in_the_middle_of_a_phase():
    env, first = cars(), learner(cars(), frames=1024)
    batches = list(Rollout(env, first.policy, 32, [*first.keys]).collect() for _ in range(5))
    for batch in batches[:3]:
        first.update(batch.clone())
    second = learner(cars(), frames=1024, seed=5)
    second.start = first.start
    second.load_state_dict(deepcopy(first.state_dict()))
    for batch in batches[3:]:
        assert first.update(batch.clone()) == second.update(batch.clone())
    assert changed(weights(first), weights(second)) == [False] * 4


def test_a_state_of_other_guides_is_refused():
    state = learner(cars()).state_dict()
    with pytest.raises(ValueError, match="the state is of the guides left, right, not right, left"):
        learner(cars(), guides=("right", "left")).load_state_dict(state)


def test_what_cannot_learn_is_refused():
    env = cars()
    straight = TensorDictModule(lambda seen: seen[..., :1] * 0, ["observation"], ["action"])
    with pytest.raises(ValueError, match="guide 'straight' has no parameters"):
        DynamicCoil(env, guides={"straight": straight})
    one = guide(env)
    with pytest.raises(ValueError, match="two of the guides share parameters"):
        DynamicCoil(env, guides={"one": one, "two": one})
    with pytest.raises(ValueError, match="guides learn through actions that are numbers"):
        DynamicCoil(worlds.carts(), guides={"one": guide(env)})
    with pytest.raises(ValueError, match="shrink=0 must be more than 0"):
        DynamicCoil(env, guides={"one": guide(env)}, shrink=0)
    with pytest.raises(ValueError, match="critic_phases='never' must be one of both"):
        DynamicCoil(env, guides={"one": guide(env)}, critic_phases="never")


def test_a_guide_learns_to_steer_an_agent_that_never_learns():
    """What pays is to steer left; only through what it tells the agent can the guide bring that about."""
    env = cars()
    of = learner(env, guides=("only",), phases={"order": "guide"}, gamma=0.0, epochs=8)
    rollout = Rollout(env, of.policy, 32, [*of.keys])
    seen = rollout.collect().select("observation")

    def steering():
        return float(of.policy.get_dist(seen.copy()).deterministic_sample.detach().mean())

    before = steering()
    for _ in range(8):
        batch = rollout.collect()
        batch["next", "reward"] = batch["action"].clone()
        of.update(batch)
    assert steering() > before + 0.02
