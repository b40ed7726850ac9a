"""Every experiment file of the paper is a sweep that can be run and resumed."""

from pathlib import Path

import pytest
from programs import TINY_SWEEP

from coil_paper import conf, sweeps
from coil_rl import compose_train
from coil_rl.config.check import check
from coil_rl.programs.train import train

EXPERIMENTS = sorted(file.stem for file in Path(conf.__path__[0], "experiment").glob("*.yaml"))


def first(experiment, run_dir):
    """Return a very small configuration of the first run of the sweep."""
    words = next(sweeps.choices(experiment, [f"+experiment={experiment}"]))
    return compose_train([*words, *TINY_SWEEP, f"run_dir={run_dir}"])


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_trains_and_evaluates(experiment, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "run"
    config = first(experiment, run)
    assert config.existing == "resume"
    run.mkdir()
    check(config)
    train(config)
    assert (run / "evaluation.csv").exists()
