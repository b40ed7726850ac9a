"""Every experiment file is a sweep that can be run and resumed."""

from importlib.util import find_spec

import pytest
from omegaconf import OmegaConf
from programs import CONFS, TINY_SWEEP, composed, shipped_file

from coil_rl.config.check import check
from coil_rl.programs.train import train

FOLDERS = [conf / "experiment" for conf in CONFS]
EXPERIMENTS = sorted(
    file.relative_to(folder).with_suffix("").as_posix()
    for folder in FOLDERS
    for file in folder.rglob("*.yaml")
)
OF_TRACKS = ("track", "env.", "evaluation.curve.env.")  # words of worlds with tracks
NEEDS_RUNS = ["driving_tasks"]
NEEDS_EXTRA = {"guide_benchmark/babyai": "minigrid", "guide_benchmark/swimmer": "mujoco"}


def with_tracks(experiment):
    """Return whether an experiment is about a world with tracks."""
    task = experiment.removeprefix("guide_benchmark/")
    return experiment != "promise" and (task == experiment or task.startswith("cones"))


def present(experiment):
    """Return whether the extra of an experiment is installed."""
    return not (extra := NEEDS_EXTRA.get(experiment)) or find_spec(extra) is not None


def first(experiment, run_dir):
    """Return a very small configuration of the first run of the sweep."""
    # A file that inherits its sweep has no params of its own.
    file = OmegaConf.load(shipped_file("experiment", experiment))
    params = OmegaConf.select(file, "hydra.sweeper.params") or {}
    values = {key: str(value).split(",") for key, value in params.items()}
    chosen = [
        f"{key}={value[0].strip()}"
        for key, value in values.items()
        if not key.startswith("budget.")
    ]
    tiny = TINY_SWEEP
    if "guide_benchmark/" in experiment:
        chosen = [word for word in chosen if not word.startswith("+arm")] + ["+arm=intact"]
    if not with_tracks(experiment):
        tiny = [word for word in TINY_SWEEP if not word.startswith(OF_TRACKS)]
    return composed(f"+experiment={experiment}", *chosen, *tiny, f"run_dir={run_dir}")


@pytest.mark.slow
def test_every_experiment_trains_and_evaluates(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    able = [name for name in EXPERIMENTS if name not in NEEDS_RUNS and present(name)]
    for experiment in [*able, *NEEDS_RUNS]:
        for task in ("centred", "left", "right") if experiment == "driving_guides" else ("",):
            run = tmp_path / "outputs" / "experiments" / experiment / (task or "run")
            config = first(experiment, run)
            if task:
                config.env.only = task
            run.mkdir(parents=True)
            assert config.existing == "resume"
            check(config)
            train(config)
            assert (run / "evaluation.csv").exists()
