"""Properties of learners with a replay buffer."""

import math

import pytest
import torch
import worlds
from any_env import AnyEnv, action_of, learning
from tensordict import TensorDict
from torchrl.envs import PendulumEnv

from coil_rl.learners import DQN, SAC, Mlp
from coil_rl.learners.off_policy import OffPolicy
from coil_rl.learners.policy import Entries
from coil_rl.learners.rewards import NStep, discounted
from coil_rl.run.rollout import Rollout
from coil_rl.transforms import DiscreteActions, GradualResidual, JumpStart, MixedAction, Takeover


def steps(first, count, **more):
    """Steps in which every entry is the number of the step."""
    number = torch.arange(first, first + count).float().unsqueeze(-1)
    done, terminated = torch.zeros(2, count, 1, dtype=torch.bool)
    after = {"th": number.squeeze(-1), "reward": number, "done": done, "terminated": terminated}
    return TensorDict({"th": number.squeeze(-1), "action": number, "next": after, **more}, [count])


def replay(env=None, **options):
    """The buffer of a learner, without networks."""
    options = {
        "in_keys": ["th"],
        "network": Mlp(),
        "capacity": 10,
        "batch_size": 4,
        "updates_per_step": 0.25,
        "starts": 0,
        "tau": 0.1,
        "learning_rate": 1e-3,
        "max_grad_norm": None,
    } | options
    return OffPolicy(env or PendulumEnv(), **options)


def stored(learner):
    return sorted(learner.buffer[:]["action"].flatten().tolist())


def test_newest_steps_replace_the_oldest():
    learner = replay()
    for first in (0, 6, 12):
        learner.store(steps(first, 6))
    assert stored(learner) == list(range(8, 18))


def test_there_are_updates_for_each_step_once_learning_has_started():
    learner = replay(capacity=10_000, batch_size=50, updates_per_step=0.05, starts=100)
    counts = torch.zeros(1_000)
    for first in range(0, 1_000, 30):
        learner.store(steps(first, min(30, 1_000 - first)))
        for minibatch in learner.samples():
            assert minibatch["action"].flatten().max() < first + 30
            assert torch.equal(minibatch["next", "reward"], minibatch["action"])
            counts += torch.bincount(minibatch["action"].flatten().long(), minlength=1_000)
    # 90 steps are stored before the batch with which there are 100.
    assert counts.sum() == 50 * int(0.05 * (1_000 - 90))


def test_rewards_of_several_steps_are_summed_within_an_episode():
    """y needs r + gamma r' + gamma^2 r'', the state after them, and whether it terminated there."""
    whole, gamma = steps(0, 12), 0.5
    whole["next", "reward"] = torch.arange(12.0).square().unsqueeze(-1)
    whole["next", "done"][[4, 8]] = True
    whole["next", "terminated"][8] = True  # the step 4 ends a truncated episode
    ends = (4, 8, 11)
    for size in (1, 2, 5, 12):  # of a batch
        sums = NStep(3, gamma)
        parts = [sums.summed(part.unsqueeze(0)) for part in whole.split(size)]
        found = torch.cat(parts)
        places = found["action"].flatten().int().tolist()
        entries = Entries(found.items(True, True))
        added = discounted(entries, torch.tensor(gamma), torch.ones(len(found)))
        # The last two steps wait for the next batch.
        assert sorted(places) == list(range(10))
        for place, step, value in zip(places, found, added, strict=True):
            last = min(place + 2, *(end for end in ends if end >= place))
            taken = range(place, last + 1)
            expected = sum(gamma ** (each - place) * each**2 for each in taken)
            assert float(step["next", "reward"]) == expected
            assert int(step["next", "steps"]) == len(taken)
            assert float(step["next", "th"]) == last
            assert bool(step["next", "terminated"]) == (last == 8)
            assert float(value) == (0.0 if last == 8 else gamma ** len(taken))


def test_sum_does_not_reach_from_forgotten_episodes_into_new_ones():
    learner = SAC(PendulumEnv(), ["th"], n_step=3)
    learner.store(steps(0, 4))
    learner.begin_episodes()
    learner.store(steps(4, 4))
    assert stored(learner) == [0, 1, 4, 5]


def test_value_of_the_state_in_which_an_episode_was_truncated_is_limited():
    batch = steps(0, 5)
    batch["next", "done"][[1, 3, 4]] = batch["next", "terminated"][4] = True
    entries, gamma = Entries(batch.items(True, True)), torch.tensor(0.5)
    values = torch.tensor([2.0, 100.0, 6.0, 5.0, 100.0])  # mean 4, deviation 2 within the episodes
    assert discounted(entries, gamma, values).tolist() == [1.0, 3.0, 3.0, 2.5, 0.0]
    both = torch.stack([values, values], 1)
    assert discounted(entries, gamma, both)[:, 1].tolist() == [1.0, 3.0, 3.0, 2.5, 0.0]


def agent_acts(*flags):
    return torch.tensor(flags, dtype=torch.bool).unsqueeze(-1)


def test_executed_action_is_stored_where_the_guide_acts():
    learner = replay(worlds.pendulum(Takeover(0.5)))
    assert {"agent_acts", ("next", "executed_action")} <= set(learner.keys)
    given = steps(0, 6, agent_acts=agent_acts(1, 0, 0, 1, 1, 0))
    given["next", "executed_action"] = given["action"] + 10 * ~given["agent_acts"]
    learner.store(given)
    assert stored(learner) == [0, 3, 4, 11, 12, 15]


def test_steps_of_the_guide_are_not_stored_if_the_agent_cannot_choose_its_action():
    for transforms in ([Takeover(0.5), DiscreteActions(5)], [Takeover(0.5), MixedAction(0.5)]):
        env = worlds.cones(*transforms)
        learner = replay(env, in_keys=["observation"])
        assert ("next", "executed_action") not in learner.keys
        given = steps(0, 6, agent_acts=agent_acts(1, 0, 0, 1, 1, 0)).rename_key_(
            "th", "observation"
        )
        given["next"].rename_key_("th", "observation")
        learner.store(given)
        assert stored(learner) == [0, 3, 4]
        with pytest.raises(
            ValueError, match=r"prior=0\.5 needs steps in which a guide acts in place of the agent"
        ):
            replay(env, in_keys=["observation"], prior=0.5)


SWITCHES = {
    "takeover": lambda: Takeover(0.5, seed=1),
    "jump start": lambda: JumpStart(30),
    "warm start": lambda: Takeover(1.0, 30),
    "gradual residual": lambda: GradualResidual(0.5, probability=0.5, seed=1),
}


@pytest.mark.parametrize("name", SWITCHES)
def test_stored_steps_agree_with_the_env(name):
    """A fresh env, given the stored state and action, returns the stored reward and next state."""
    env = worlds.pendulum(SWITCHES[name]())
    learner = SAC(
        env,
        ["th", "thdot", "guide_action"],
        hidden=[8],
        starts=10_000,
        capacity=10_000,
        action_scale=2.0,
    )
    batch = Rollout(env, learner.policy, 60, [*learner.keys, "agent_acts"]).collect()
    assert 0.2 < batch["agent_acts"].float().mean() < 0.8
    learner.update(batch)
    taken = learner.buffer[:]
    assert len(taken) == 60
    action = taken["action"]
    if name == "gradual residual":  # the sum is a part of the env; an agent that rests adds 0
        action = (taken["guide_action"][:, 0] + 0.5 * action).clamp(-2, 2)
    state = PendulumEnv.gen_params(batch_size=[60]).update(taken.select("th", "thdot"))
    after = PendulumEnv().step(state.set("action", action))["next"]
    for key in ("th", "thdot", "reward"):
        torch.testing.assert_close(after[key], taken["next", key])


def test_steps_of_the_guide_are_sampled_as_their_share():
    learner = replay(
        worlds.pendulum(Takeover(0.5)),
        prior=0.25,
        batch_size=8,
        capacity=50,
        starts=30,
        updates_per_step=1.0,
    )
    for first, acts in ((0, False), (20, False), (40, True), (60, True)):
        given = steps(first, 20, agent_acts=torch.full((20, 1), acts))
        given["next", "executed_action"] = given["action"]
        learner.store(given)
        minibatches = list(learner.samples())
        if first == 0:
            assert not minibatches, "30 steps must be stored"
        for minibatch in minibatches:
            of_guide = (minibatch["action"] < 40).sum()
            assert len(minibatch["action"]) == 8
            assert of_guide == (2 if acts else 8)
    assert learner.kept == 80


def test_steps_are_stored_with_the_advice_before_and_after_them():
    learner, rollout = learning(SAC, worlds.cones(), ["observation", "guide_action"])
    batch = rollout.collect()
    learner.update(batch)
    steps, expected = learner.buffer[:], batch.select(*learner.stored_keys).reshape(-1)
    for key in ("guide_action", ("next", "guide_action"), "action"):
        assert torch.equal(steps[key], expected[key])
    assert not torch.equal(steps["guide_action"], steps["next", "guide_action"])


@pytest.mark.parametrize("kind", [DQN, SAC])
def test_learning_starts_after_some_steps_and_has_no_losses_before(kind):
    learner, rollout = learning(kind, AnyEnv(action=action_of(kind)), starts=80)
    first, second = (learner.update(rollout.collect()) for _ in range(2))
    assert first["minibatches"] == 0
    assert second["minibatches"] == 4
    of_minibatches = ("loss", "value", "alpha", "entropy")
    assert all(math.isnan(first[name]) == name.startswith(of_minibatches) for name in first)
    assert all(map(math.isfinite, second.values()))
