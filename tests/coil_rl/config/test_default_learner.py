import pytest

from coil_rl.config import python
from coil_rl.config.default_learner import default_learner

PENDULUM = ["env=gym", "env.id=Pendulum-v1"]
SAC = ["learner=sac", "budget.frames=100000"]


@pytest.mark.fast(4)
@pytest.mark.parametrize(
    ("words", "found"),
    [
        (PENDULUM, SAC),
        ([*PENDULUM, "guide=random", "budget.frames=64"], ["learner=sac", "learner.starts=16"]),
        (["env=gym", "env.id=CartPole-v1"], []),
        ([*PENDULUM, "learner=a2c"], []),
        ([*PENDULUM, "method=coil_anchored", "learner.gamma=0.9"], SAC),
        ([*PENDULUM, "seed=0,1"], SAC),
        (["env=torchrl", "env.of._target_=torchrl.envs.PendulumEnv"], SAC),
        ([*PENDULUM, "budget.frames=2_000"], SAC[:1]),
        ([*PENDULUM, "budget.frames=1e3"], []),
        ([*PENDULUM, "budget.frames=${evaluation.cases}"], ["learner=sac", "learner.starts=5"]),
        ([*PENDULUM, "method=ppo"], []),
        ([*PENDULUM, "network=gru"], []),
        ([*PENDULUM, "init=earlier"], []),
        (["env=gym", "env.id=Pendulum-v1,CartPole-v1"], []),
        (["env=gym", "env.id=Nothing-v0"], []),
        (["env=gym"], []),
        (["env=pendulum"], []),
        ([], []),
    ],
)
def test_actions_that_are_numbers_are_learned_by_sac(words: list[str], found: list[str]) -> None:
    assert default_learner(words) == found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "label"), [("Pendulum-v1", "sac"), ("CartPole-v1", "ppo"), ("pendulum", "ppo")]
)
def test_a_run_in_python_has_the_learner_of_the_command(tmp_path, env: str, label: str) -> None:
    run = python.prepare(env, folder=tmp_path, frames=640)
    assert run.label == label
    assert (f"learner={label}" in run.command) == (label == "sac")
