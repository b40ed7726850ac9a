"""The shipped envs of Gymnasium: each is evaluated with its public controller."""

import pytest
from programs import TINY_ARM, called, read_csv

# Of each env: what it needs, and the least mean reward of its controller.
ENVS = {
    "lunar_lander": ("Box2D", 200),
    "bipedal": ("Box2D", -200),
    "mountain_car": ("gymnasium", 88),
    "pendulum": ("gymnasium", -400),
    "cart_pole": ("gymnasium", 500),
    "swimmer": ("mujoco", 300),
    "babyai": ("minigrid", 0.5),
}


@pytest.mark.slow
@pytest.mark.parametrize("env", ENVS)
def test_controller_of_an_env_is_evaluated(env, tmp_path):
    package, least = ENVS[env]
    pytest.importorskip(package)
    called("evaluate", f"env={env}", "evaluation.cases=2", "hydra.run.dir=run", cwd=tmp_path)
    rows = read_csv(tmp_path / "run" / "evaluation.csv")
    rewards = {row["case"]: float(row["reward"]) for row in rows}
    assert rewards["mean"] >= least


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [["env.options.continuous=false"], ["guide=none", "method=ppo"]]
)
def test_lunar_lander_trains_with_discrete_actions_and_without_a_guide(options, tmp_path):
    pytest.importorskip("Box2D")
    short = [*TINY_ARM, "env.max_steps=60", "evaluation.gif=false", "logger=none", *options]
    called("train", "env=lunar_lander", *short, "hydra.run.dir=run", cwd=tmp_path)
    assert (tmp_path / "run" / "evaluation.csv").exists()
