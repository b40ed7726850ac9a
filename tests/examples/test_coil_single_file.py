"""The single file computes what the library computes, from the same weights and the same steps."""

import ast
import sys

import gymnasium
import numpy as np
import pytest
import torch
from programs import ROOT
from torchrl.envs import Compose, RewardSum, TransformedEnv

from coil_rl import PPO, GuideActions, GymnasiumEnv, NormalisedAction, Rollout
from coil_rl.guides import EntryGuide
from coil_rl.schedules import Linear

FILE = ROOT / "examples" / "coil_single_file.py"
UPDATES = 4


@pytest.fixture(scope="module")
def single():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FILE.parent)
        import coil_single_file

        yield coil_single_file
        sys.modules.pop("coil_single_file", None)


def lean(observation):
    return int(observation[2] > 0)


def world(id, guide):
    """Return envs of the library with the advice of a guide, whose episodes are cut off, too."""
    env = GymnasiumEnv(id, 4, max_steps=15, controllers={"own": lambda env, seen: guide(seen)})
    advice = GuideActions({"own": EntryGuide(("controller", "own"))})
    return TransformedEnv(env, Compose(NormalisedAction(), advice, RewardSum()))


def difference(ours, theirs):
    """Return the largest difference of two lists of weights."""
    pairs = zip(ours, theirs, strict=True)
    return max(float((one - other).detach().abs().max()) for one, other in pairs)


def batch_of(single, batch):
    """Return a batch of the library as one of the single file."""

    def seen(step):
        return torch.cat([step["observation"], step["guide_action"].flatten(2)], -1)

    after = batch["next"]
    return single.Batch(
        seen(batch),
        batch["action"],
        batch["action_log_prob"],
        after["reward"].squeeze(-1),
        after["terminated"].squeeze(-1),
        after["done"].squeeze(-1),
        seen(after),
    )


@pytest.mark.slow
@pytest.mark.parametrize("id", ["Pendulum-v1", "CartPole-v1"])
def test_weights_are_those_of_the_library_after_some_updates(id, single):
    torch.manual_seed(0)
    env = world(id, single.swing_up if id == "Pendulum-v1" else lean)
    observed = ["observation", "guide_action"]
    library = PPO(env, observed, minibatches=4, learning_rate=Linear(1e-3, 0.0), compile=False)
    rollout = Rollout(env, library.policy, 32)
    first = rollout.collect()
    size = first["observation"].shape[-1] + first["guide_action"].shape[-1]
    choices = id == "CartPole-v1"
    agent = single.Agent(size, 2 if choices else 1, choices)
    ours = [*agent.parameters()]
    theirs = [*library.policy.parameters(), *library.critic.parameters()]
    if choices:
        ours = ours[1:]  # no standard deviation
    assert [one.shape for one in ours] == [other.shape for other in theirs]
    with torch.no_grad():
        for one, other in zip(ours, theirs, strict=True):
            one.copy_(other)
    ppo, before = single.PPO(agent, minibatches=4), [each.clone() for each in theirs]
    for number in range(UPDATES):
        batch = first if number == 0 else rollout.collect()
        assert bool((batch["next", "done"] & ~batch["next", "terminated"]).any())
        ppo.update(batch_of(single, batch), number / UPDATES)
        library.update(batch, number / UPDATES)
    assert difference(theirs, before) > 1e-3
    # Some sums are taken in another order.
    assert difference(ours, theirs) < 1e-6


def test_what_it_collects_is_what_it_learns_from(single):
    torch.manual_seed(0)
    envs = single.Envs("Pendulum-v1", 2, single.swing_up, seed=3)
    agent = single.Agent(envs.size, envs.actions, False)
    batch = single.collect(envs, agent, 205)  # episodes have 200 steps
    assert batch.seen.shape == (2, 205, 4)
    assert batch.done.sum() == 2
    assert not batch.terminated.any()
    torch.testing.assert_close(batch.seen[:, 1:200], batch.after[:, :199])
    assert not torch.equal(batch.seen[:, 200], batch.after[:, 199]), "a new episode began"
    torch.testing.assert_close(batch.log_prob, agent.log_prob(batch.seen, batch.action))
    env = gymnasium.make("Pendulum-v1")
    observation, _ = env.reset(seed=4)
    expected = np.append(observation, single.swing_up(observation) / 2)
    np.testing.assert_allclose(batch.seen[1, 0], expected, rtol=1e-6)
    assert envs.returns == pytest.approx(batch.reward[:, :200].sum(1).tolist(), rel=1e-5)


@pytest.mark.fast(1)
@pytest.mark.parametrize("words", ["--env Pendulum-v1", "--env CartPole-v1 --method ppo"])
def test_program_runs(words, single, capsys):
    returns = single.main([*words.split(), *["--frames", "512", "--envs", "2", "--steps", "128"]])
    assert all(np.isfinite(returns))
    assert capsys.readouterr().out.count("frames, return") == 2


def test_file_needs_nothing_of_this_package():
    tree = ast.parse(FILE.read_text())
    modules = {
        name.split(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, (ast.Import, ast.ImportFrom))
        for name in (
            [node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
        )
    }
    assert modules - set(sys.stdlib_module_names) == {"gymnasium", "numpy", "torch"}
    assert len(FILE.read_text().splitlines()) <= 250
