"""The shipped envs of Gymnasium: each is evaluated with its public controller."""

import csv

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
