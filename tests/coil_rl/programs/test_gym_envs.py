"""The shipped envs of Gymnasium: each is evaluated with its public controller.

Some of them also train, are killed and resume.
"""

import csv
import signal
import time

import kill_and_resume
import pytest
from programs import called

PACKAGES = {
    "lunar_lander": "Box2D",
    "bipedal": "Box2D",
    "mountain_car": "gymnasium",
    "pendulum": "gymnasium",
    "cart_pole": "gymnasium",
    "swimmer": "mujoco",
    "babyai": "minigrid",
}
LEAST = {
    "lunar_lander": 200,
    "mountain_car": 88,
    "pendulum": -400,
    "cart_pole": 500,
    "swimmer": 300,
    "babyai": 0.5,
}
SMALL = [
    "budget.frames=512",
    "budget.num_envs=4",
    "budget.steps=32",
    "learner.minibatches=2",
    "learner.epochs=1",
    "evaluation.cases=2",
    "evaluation.repeats=1",
    "evaluation.gif=false",
    "evaluation.curve.num_envs=2",
    "checkpoint_every=1",
    "logger=none",
]


@pytest.mark.slow
@pytest.mark.parametrize("env", PACKAGES)
def test_controller_of_an_env_is_evaluated(env, tmp_path):
    pytest.importorskip(PACKAGES[env])
    called("evaluate", f"env={env}", "evaluation.cases=2", "hydra.run.dir=run", cwd=tmp_path)
    with (tmp_path / "run" / "evaluation.csv").open(newline="") as file:
        rewards = {row["case"]: float(row["reward"]) for row in csv.DictReader(file)}
    assert rewards["mean"] >= LEAST.get(env, -200)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [["env.options.continuous=false"], ["guide=none", "method=ppo"]]
)
def test_lunar_lander_trains_with_discrete_actions_and_without_a_guide(options, tmp_path):
    pytest.importorskip("Box2D")
    short = [*SMALL, "budget.frames=128", "env.max_steps=60", *options]
    called("train", "env=lunar_lander", *short, "hydra.run.dir=run", cwd=tmp_path)
    assert (tmp_path / "run" / "evaluation.csv").exists()


@pytest.mark.slow
@pytest.mark.parametrize("env", ["lunar_lander", "cart_pole"])
def test_killed_run_ends_like_an_uninterrupted_one(env, tmp_path, monkeypatch):
    pytest.importorskip(PACKAGES[env])
    monkeypatch.setattr(kill_and_resume, "SMALL", [])
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    called("train", f"env={env}", *SMALL, f"hydra.run.dir={whole}", cwd=tmp_path)
    process, began = kill_and_resume.start(resumed, [f"env={env}", *SMALL]), time.monotonic()
    while not (resumed / "checkpoint.pt").exists() or kill_and_resume.marks(resumed) < 4:
        assert process.poll() is None
        assert time.monotonic() < began + kill_and_resume.TIMEOUT
        time.sleep(0.002)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    called("train", f"resume={resumed}", cwd=tmp_path)
    for name in kill_and_resume.LOGS:
        assert (resumed / name).read_bytes() == (whole / name).read_bytes(), name
