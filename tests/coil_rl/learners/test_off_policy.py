"""Properties of learners with a replay buffer."""

import copy
import math

import pytest
import torch
import worlds
from tensordict import TensorDict
from torchrl.envs import Compose, PendulumEnv, TransformedEnv

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import RandomGuide
from coil_rl.learners import DQN, SAC
from coil_rl.learners.off_policy import OffPolicy
from coil_rl.run.rollout import Rollout
from coil_rl.transforms import (
    DelayedAdvice,
    DiscreteActions,
    GradualResidual,
    GuideActions,
    JumpStart,
    MixedAction,
    Takeover,
)


def steps(first, count, **more):
    """Steps in which every entry is the number of the step."""
    number = torch.arange(first, first + count).float().unsqueeze(-1)
    flag = torch.zeros_like(number, dtype=torch.bool)
    after = {"th": number.squeeze(-1), "reward": number, "done": flag, "terminated": flag}
    return TensorDict({"th": number.squeeze(-1), "action": number, "next": after, **more}, [count])


def replay(env=None, **options):
    """The buffer of a learner, without networks."""
    options = {
        "in_keys": ["th"],
        "capacity": 10,
        "batch_size": 4,
        "ratio": 1.0,
        "starts": 0,
        "tau": 0.1,
    } | options
    return OffPolicy(env or PendulumEnv(), **options)


def stored(learner):
    return sorted(learner.buffer[:]["action"].flatten().tolist())


def test_newest_steps_replace_the_oldest():
    learner = replay()
    for first in (0, 6, 12):
        learner.store(steps(first, 6))
    assert stored(learner) == list(range(8, 18))


def test_steps_are_sampled_as_often_as_the_ratio():
    learner = replay(capacity=10_000, batch_size=50, ratio=2.5)
    counts = torch.zeros(1_000)
    for first in range(0, 1_000, 30):
        learner.store(steps(first, min(30, 1_000 - first)))
        for minibatch in learner.samples():
            assert minibatch["action"].flatten().max() < first + 30
            assert torch.equal(minibatch["next", "reward"], minibatch["action"])
            counts += torch.bincount(minibatch["action"].flatten().long(), minlength=1_000)
    assert counts.sum() == 2.5 * 1_000


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
    if (
        name == "gradual residual"
    ):  # the sum is a part of the env, and the agent's action is 0 where it does not act
        action = (taken["guide_action"][:, 0] + 0.5 * action).clamp(-2, 2)
    state = PendulumEnv.gen_params(batch_size=[60]).update(taken.select("th", "thdot"))
    after = PendulumEnv().step(state.set("action", action))["next"]
    for key in ("th", "thdot", "reward"):
        torch.testing.assert_close(after[key], taken["next", key])


def test_steps_of_the_guide_are_sampled_as_their_share():
    learner = replay(
        worlds.pendulum(Takeover(0.5)), prior=0.25, batch_size=8, capacity=50, starts=30, ratio=8.0
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
            assert len(minibatch) == 8
            assert of_guide == (2 if acts else 8)
    assert learner.kept == 80


TINY = {"starts": 20, "batch_size": 16, "ratio": 2, "capacity": 90, "hidden": [8]}


def make(kind, seed=0, **changes):
    """A learner and its rollouts, with random, delayed advice, which no observation determines."""
    torch.manual_seed(seed)
    advice = [GuideActions({"any": RandomGuide(seed=seed)}), DelayedAdvice(2)]
    discrete = [DiscreteActions(5)] if kind is DQN else []
    env = TransformedEnv(
        ConeTrackEnv(shipped_tracks("train")[:2], 8, seed=seed), Compose(*advice, *discrete)
    )
    learner = kind(env, ["observation", "guide_action"], seed=seed, **TINY | changes)
    return learner, Rollout(env, learner.policy, 4, learner.keys)


@pytest.mark.parametrize("kind", [DQN, SAC])
@pytest.mark.parametrize("updates", [1, 4], ids=["buffer not full", "buffer full"])
def test_state_contains_everything_the_next_update_depends_on(kind, updates):
    first, rollout = make(kind)
    for _ in range(updates):
        first.update(rollout.collect())
    second, _ = make(kind, seed=9)
    state = copy.deepcopy(first.state_dict())
    assert len(state["buffers"][0]["steps"]["action"]) == min(32 * updates, 90)
    second.load_state_dict(state)
    batch, metrics, actions = rollout.collect(), [], []
    for learner in (first, second):
        torch.manual_seed(1)  # SAC samples actions
        metrics.append(learner.update(batch.clone()))
        actions.append(learner.policy(batch.clone())["action"])
    assert metrics[0] == metrics[1]
    assert torch.equal(*actions)
    assert (first.buffer[:] == second.buffer[:]).all()
    assert len(first.guide_buffer) == 0


def test_steps_are_stored_with_the_advice_before_and_after_them():
    learner, rollout = make(SAC)
    batch = rollout.collect()
    learner.update(batch)
    steps, expected = learner.buffer[:], batch.select(*learner.stored_keys).reshape(-1)
    assert len(steps) == 32
    for key in ("guide_action", ("next", "guide_action"), "action"):
        assert torch.equal(steps[key], expected[key])
    assert not torch.equal(steps["guide_action"], steps["next", "guide_action"])


@pytest.mark.parametrize("kind", [DQN, SAC])
def test_learning_starts_after_some_steps_and_has_no_losses_before(kind):
    learner, rollout = make(kind, starts=40)
    first, second = (learner.update(rollout.collect()) for _ in range(2))
    assert first["minibatches"] == 0
    assert second["minibatches"] == 8
    of_minibatches = ("loss", "value", "alpha", "entropy")
    assert all(math.isnan(first[name]) == name.startswith(of_minibatches) for name in first)
    assert all(map(math.isfinite, second.values()))


@pytest.mark.parametrize(
    ("kind", "name"), [(DQN, "value_network_params"), (SAC, "qvalue_network_params")]
)
def test_target_network_follows_by_tau(kind, name):
    learner, rollout = make(kind, starts=0, ratio=0.5, tau=0.25)
    params, target_params = getattr(learner.loss, name), getattr(learner.loss, f"target_{name}")
    before = target_params.clone()
    assert learner.update(rollout.collect())["minibatches"] == 1
    for key, value in target_params.items(True, True):
        torch.testing.assert_close(value, 0.75 * before[key] + 0.25 * params[key].detach())
