"""Runs from Python: the lines of the docs on a stranger's package, and what an object may be."""

import json
import math
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from odd_parts import Gain
from programs import called, read_csv
from torchrl.envs import PendulumEnv

import coil_rl
from coil_rl import Run
from coil_rl.config import nodes
from coil_rl.errors import UserError
from coil_rl.run import checkpoint

ENV = "thermostat:Room-v0"
SMALL = ["budget.num_envs=2", "budget.steps=16", "learner.minibatches=2", "logger=none"]
SMALL += ["evaluation.cases=2", "evaluation.curve.num_envs=2", "evaluation.curve.points=2"]
SMALL += ["checkpoint_every=1", "evaluation.gif=false"]
SHORT = [*SMALL, "env.max_steps=20", "learner=ppo"]
OF_A_LEARNER = ("budget.", "learner", "checkpoint_every=")


@pytest.fixture(autouse=True)
def place(thermostat, monkeypatch, tmp_path):
    """Work in a folder."""
    monkeypatch.chdir(tmp_path)


class Held:
    """A controller with a state of its own, which no import path names."""

    def __init__(self, power):
        self.power = power

    def act(self, observation):
        return np.array([self.power if observation[0] < 0 else 0.0])


def proportional(observation):
    """Return the power for one observation [2]."""
    return np.clip(-0.2 * observation[0], 0, 1)


@pytest.mark.slow
def test_folder_made_with_an_object_is_opened_with_the_object(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    guide = Held(0.7)
    coil_rl.train(ENV, guide=guide, method="coil", frames=32, folder=folder, overrides=SHORT)
    observation = np.array([-6.0, 3.0], np.float32)
    expected = coil_rl.open_run(folder).controller().act(observation)
    saved = (folder / "config.yaml").read_text()
    old = saved.replace("coil_rl.config.nodes.kept", "coil_rl.config.given.kept")
    assert old != saved
    (folder / "config.yaml").write_text(old)  # of an earlier version
    monkeypatch.setattr(nodes, "_objects", {})  # as in another process
    refused = called("evaluate", f"run={folder}", "trust=[thermostat]", code=2).stderr
    assert "made in Python with an object as its guide, which no import path names" in refused
    assert "coil_rl.open_run(FOLDER, guide=OBJECT)" in refused
    opened = coil_rl.open_run(folder, guide=Held(0.7), trust=["thermostat"])
    assert opened.controller().act(observation) == pytest.approx(expected)
    with pytest.raises(UserError, match="env: the run names its own env"):
        coil_rl.open_run(folder, env=Held, trust=["thermostat"])


def rewards_of_guide(table):
    return list(table[(table["driver"] == "guide") & (table["case"] != "mean")]["reward"])


FEW = ["evaluation.cases=2", "evaluation.gif=false", "env.max_steps=5"]


@pytest.mark.slow
def test_guide_alone_drives_in_as_many_cases_as_are_asked_for(tmp_path, capsys):
    guide, folder, few = "thermostat.control:PI", tmp_path / "run", [FEW[0], FEW[2]]
    run = coil_rl.prepare(ENV, guide=guide, method="guide", folder=folder, overrides=few)
    two, four = (rewards_of_guide(run.evaluate(cases=cases)) for cases in (2, 4))
    assert two == four[:2]
    assert len(set(four)) == 4
    assert "is not drawn" not in capsys.readouterr().err, "pictures are drawn where they are kept"
    run.evaluate(folder=str(tmp_path / "tables"))
    assert (tmp_path / "tables" / "evaluation.csv").exists()
    assert "is not drawn" in capsys.readouterr().err


@pytest.mark.slow
def test_rows_of_a_guide_are_those_of_the_object_that_was_handed_over(tmp_path):
    folder = tmp_path / "run"
    run = coil_rl.prepare(ENV, guide=Held(0.7), method="guide", folder=folder, overrides=FEW)
    run.begin()
    first = rewards_of_guide(run.evaluate())
    other = coil_rl.open_run(folder, guide=Held(0.1), trust=["thermostat"])
    assert rewards_of_guide(other.evaluate()) != first
    again = coil_rl.open_run(folder, guide=Held(0.7), trust=["thermostat"])
    assert rewards_of_guide(again.evaluate()) == first


@pytest.mark.slow
def test_controller_as_a_guide_is_the_policy_that_was_asked_for(tmp_path):
    words = [*SHORT, "delivery=tested", "learner.action_gain=1"]
    run = coil_rl.prepare(ENV, method="ppo", frames=32, folder=tmp_path / "run", overrides=words)
    for seed, which in enumerate(("last", "handed_over")):
        torch.manual_seed(seed)
        policy = run.make_learner(run.make_env()).policy
        checkpoint.save(policy.state_dict(), run.folder / f"policy_{which}.pt")
    run.begin()
    observation, actions = np.array([-6.0, 3.0], np.float32), []
    for which in (None, "last", "handed_over"):
        controller = run.controller(which)
        guided = coil_rl.prepare(ENV, guide=controller, method="guide", folder=tmp_path / "guided")
        actions.append(float(controller.act(observation)[0]))
        assert guided.controller().act(observation)[0] == pytest.approx(actions[-1])
    assert actions[0] == actions[2] != actions[1]


@pytest.fixture
def alone(tmp_path):
    """Return a run of a guide alone that has not begun."""
    return coil_rl.prepare(ENV, guide=proportional, method="guide", folder=tmp_path / "run")


@pytest.mark.fast(4)
@pytest.mark.parametrize(
    ("call", "message"),
    [
        *(
            (partial(use, **{name: number}), rf"^{name}={number!r} must be a whole number of")
            for name, use in (("cases", Run.evaluate), ("frames", Run.train))
            for number in (0, -1, 2.5, True, "3")
        ),
        (lambda run: run.controller("best"), "which='best' must be handed_over or last; with del"),
        (
            lambda run: coil_rl.train(run, folder=run.folder),
            r"^env is Run; .* a Run is trained by its train\(\)",
        ),
        (
            lambda run: coil_rl.train(3, folder=run.folder),
            "env is int; give the id of a Gymnasium env",
        ),
        (
            lambda run: coil_rl.train(ENV, method="coill", folder=run.folder),
            "there is no method=coill",
        ),
        (
            lambda run: coil_rl.train("NoSuchEnv-v3", folder=run.folder),
            "NoSuchEnv-v3 cannot be made",
        ),
    ],
)
def test_mistake_is_one_sentence(call, message, tmp_path):
    alone = coil_rl.prepare(ENV, guide=proportional, method="guide", folder=tmp_path / "run")
    with pytest.raises(UserError, match=message) as refusal:
        call(alone)
    assert "\n" not in str(refusal.value)
    assert not [*tmp_path.rglob("config.yaml")]


@pytest.mark.slow
def test_torchrl_env_is_an_env(tmp_path):
    words = [*SMALL, "observes=[th,thdot]", "env.max_steps=10"]
    run = coil_rl.prepare(PendulumEnv, method="ppo", folder=tmp_path / "run", overrides=words)
    assert run.make_env(3).batch_size == (3,)


@pytest.mark.slow
def test_longer_run_goes_on_and_says_what_its_schedules_mean(tmp_path, capsys):
    folder = tmp_path / "run"
    run = coil_rl.train(ENV, frames=64, folder=folder, overrides=SHORT)
    first = read_csv(folder / "metrics.csv")
    with pytest.raises(UserError, match=r"has budget\.frames=64, more than 32"):
        run.train(frames=32)
    capsys.readouterr()
    called("train", f"resume={folder}", "budget.frames=128", "trust=[thermostat]")
    longer = read_csv(folder / "metrics.csv")
    learned = [name for name in first[0] if name.startswith(("train/", "learner/"))]
    kept = [[row[name] for name in learned] for row in longer[: len(first)]]
    assert kept == [[row[name] for name in learned] for row in first]
    assert [float(row["frames"]) for row in longer] == [0, 32, 64, 96, 128]
    rates = [float(row["learner/learning_rate"]) for row in longer[1:]]
    # Half of the way of the new length, where the rate of the first length had fallen to 0.
    assert rates == pytest.approx([1e-3, 5e-4, 5e-4, 2.5e-4])
    evaluated = [float(row["frames"]) for row in longer if row["evaluation/return"] != "nan"]
    assert evaluated == [0, 32, 64, 96, 128]
    opened = coil_rl.open_run(folder, trust=["thermostat"])
    assert (opened.budget.frames, list(opened.budget.stages)) == (128, [64])
    error = called("train", f"resume={folder}", "budget.frames=160", "trust=[thermostat]").stderr
    called("evaluate", f"run={folder}", "trust=[thermostat]", "hydra.run.dir=again")
    assert "coil-train" in called("info", f"run={folder}").stdout
    assert "goes on from 128 to 160 frames" in error
    assert "schedules over the run, such as a learning rate, go on at 80% of their way" in error


@pytest.mark.slow
def test_run_begins_from_the_policy_and_normaliser_of_another(tmp_path):
    words = [*SHORT, "learner.normalise=true"]
    first = coil_rl.train(ENV, frames=64, folder=tmp_path / "first", overrides=words)
    words += ["learner.learning_rate=0", f"init={first.folder}"]
    second = coil_rl.train(ENV, frames=32, seed=5, folder=tmp_path / "second", overrides=words)
    before = checkpoint.load(first.folder / "policy_last.pt")
    after = checkpoint.load(second.folder / "policies" / f"{0:012d}.pt")
    assert all(torch.equal(before[name], after[name]) for name in before)
    words = [*SHORT, "learner.hidden=[8]", f"init={first.folder}"]
    with pytest.raises(UserError, match=r"init=.*: its policy does not fit this run"):
        coil_rl.train(ENV, frames=32, folder=tmp_path / "third", overrides=words)
    assert not (tmp_path / "third").exists()


def test_run_from_parts_is_trained_resumed_and_reported(tmp_path):
    from coil_rl import PPO, Budget, EnvMaker, Evaluation, GymnasiumEnv, Trial

    def bare(rows, cases, count):
        if cases == "train":
            return GymnasiumEnv(ENV, rows or 2)
        seeds = {"test": 1000, "evaluation": 2000, "selection": 3000}
        return GymnasiumEnv(ENV, rows, first_seed=seeds[cases], cases=count or 2)

    make_env = EnvMaker(bare, sizes={"evaluation": 2, "selection": 2})
    parts = {
        "make_env": make_env,
        "make_learner": lambda env: PPO(env, minibatches=2),
        "make_trial": lambda: Trial("mine", Evaluation(["0", "1"]), make_env),
        "budget": Budget(frames=96, steps=16, points=2, checkpoint_every=1),
        "label": "mine",
    }
    run = Run(tmp_path / "runs" / "mine", **parts).train()
    assert math.isfinite(run.evaluate()["reward"].mean())
    again = Run(tmp_path / "runs" / "mine", **parts)
    reward = float(read_csv(run.folder / "evaluation.csv")[-1]["reward"])
    assert again.finish_begun() == pytest.approx(reward)
    called("report", f"folder={tmp_path / 'runs'}")
    assert "mine" in (tmp_path / "runs" / "report.md").read_text()
    refused = called("evaluate", f"run={run.folder}", code=2).stderr
    assert "was made in Python from parts, which no file names" in refused


@pytest.mark.slow
def test_edited_configuration_of_a_finished_run_is_refused(tmp_path):
    run = coil_rl.train(ENV, frames=32, folder=tmp_path / "run", overrides=SHORT)
    file = run.folder / "config.yaml"
    file.write_text(file.read_text().replace("gamma: 0.99", "gamma: 0.9"))
    refused = called("train", f"resume={run.folder}", "trust=[thermostat]", code=2).stderr
    assert "belongs to a run with learner.gamma=0.99, not 0.9" in refused
    with pytest.raises(UserError, match=r"belongs to a run with learner\.gamma"):
        coil_rl.open_run(run.folder, trust=["thermostat"]).train(frames=64)
    assert (run.folder / "evaluation.csv").exists()


@pytest.mark.slow
def test_numbers_of_a_class_are_tuned(tmp_path):
    words = [word for word in SHORT if not word.startswith(OF_A_LEARNER)]
    options = {"method": "tune", "tune": {"gain": [-2, 2]}, "frames": 700, "overrides": words}
    run = coil_rl.train("Pendulum-v1", guide=Gain, folder=tmp_path / "run", **options)
    assert set(json.loads((run.folder / "tuned.json").read_text())) == {"gain"}
    assert run.controller().act(np.zeros(3, np.float32)).shape == (1,)


@pytest.mark.parametrize("name", ["state_value", "loc", "episode_reward"])
def test_entry_that_a_training_overwrites_is_refused(name, tmp_path):
    def make():
        env = gymnasium.make("Pendulum-v1")
        space = gymnasium.spaces.Dict({name: env.observation_space})
        return gymnasium.wrappers.TransformObservation(env, lambda seen: {name: seen}, space)

    with pytest.raises(UserError, match=f"an entry {name}, a name under which a training writes"):
        coil_rl.train(make, method="ppo", folder=tmp_path / "run", overrides=[f"observes=[{name}]"])
