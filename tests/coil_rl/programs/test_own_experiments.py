"""The shipped experiments with an env and a controller of somebody else."""

import pytest
from omegaconf import OmegaConf
from programs import called, composed, shipped, shipped_file

from coil_rl.config.check import check

# What each experiment needs besides an env of one's own.
WITH_A_GUIDE = [
    *("advice", "advice_better_guide", "anchored", "coil_vs_ppo", "guide_benchmark"),
    *("guide_phase", "guide_quality", "guide_removed", "learners", "methods", "placebo"),
]
OWN = dict.fromkeys(WITH_A_GUIDE, "controller")
OWN |= {"dynamic_coil": "[controller,random,zero]", "listening": "[controller,random]"}
OF_OUR_ENVS = (
    *("advice_noisy_view", "advice_slow_control", "advice_sparse_reward", "driving_guides"),
    *("driving_tasks", "robot_delay", "promise"),
)
ENV = [
    "env=gym",
    "env.id=odd_parts:Plain",
    "guide.controller.of=odd_parts:first",
    "evaluation.cases=2",
    "logger=none",
]
TINY = ["budget.num_envs=2", "budget.steps=64", "evaluation.curve.num_envs=2"]


def jobs(experiment):
    """Return the overrides of the first seed of each job of an experiment."""
    file = OmegaConf.load(shipped_file("experiment", experiment))
    if OmegaConf.select(file, "hydra.sweeper.params") is None:
        file = OmegaConf.load(shipped_file("experiment", file.defaults[0]))
    words = [[]]
    for key, value in file.hydra.sweeper.params.items():
        choices = str(value).split(",")[: 1 if key == "seed" else None]
        words = [[*word, f"{key}={choice.strip()}"] for word in words for choice in choices]
    return words


def test_every_experiment_is_for_any_env_or_for_one_of_ours():
    assert sorted({*OWN, *OF_OUR_ENVS}) == shipped("experiment")


@pytest.mark.slow
@pytest.mark.parametrize("experiment", sorted(OWN))
def test_jobs_of_an_experiment_can_be_started_in_an_own_env(experiment, tmp_path):
    checked = set()
    for job in jobs(experiment):
        words = [f"+experiment={experiment}", f"guide={OWN[experiment]}", *ENV, *job]
        config = composed(*words, f"run_dir={tmp_path}")
        assert not config.track
        if not any(word.startswith("budget.frames=") for word in job):
            frames = {"method=oil": 18_900, "method=dagger": 22_400}.get(job[0], 200_000)
            assert config.budget.frames == frames  # those of the env, not of the cone world
        if job[0] != "learner=dqn" and not checked.issuperset(job):
            check(config)
        checked.update(job)


def test_own_file_that_overrides_a_group_of_another_env_is_named(tmp_path):
    file = tmp_path / "conf" / "experiment" / "mine.yaml"
    file.parent.mkdir(parents=True)
    file.write_text("# @package _global_\ndefaults: [override /track: unseen]\n")
    words = ["--config-dir", str(tmp_path / "conf"), "+experiment=mine", "guide=controller", *ENV]
    refused = called("train", *words, cwd=tmp_path, code=2).stderr
    assert "In 'experiment/mine': Could not override 'track'" in refused


@pytest.mark.slow
def test_experiment_that_is_a_sweep_trains_in_an_own_env(tmp_path):
    words = ["+experiment=coil_vs_ppo", "guide=controller", *ENV, *TINY]
    words += ["budget.frames=256", "budget.minibatches=4", "evaluation.curve.points=1", "seed=0"]
    called("train", *words, cwd=tmp_path)
    folders = sorted(path.parent.name for path in tmp_path.rglob("evaluation.csv"))
    assert folders == ["coil_seed0", "ppo_seed0"]
