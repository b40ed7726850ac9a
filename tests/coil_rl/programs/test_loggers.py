"""Runs with each logger: what it holds, and that they are evaluated and resumed without trust."""

import importlib.util
import json
import sqlite3
from pathlib import Path

import pytest
from programs import TINY, TRACK, called

QUICK = [*TINY, "evaluation.gif=false", "method=ppo", "learner.epochs=1", "hydra.run.dir=run"]


def csv_of(folder):
    scalars = folder / "csv" / "scalars" / "train" / "return.csv"
    (texts,) = (folder / "csv" / "texts").glob("hparams*")
    return texts.read_text(), [line.split(",")[0] for line in scalars.read_text().splitlines()]


def wandb_of(folder):
    (file,) = (folder / "wandb").glob("offline-run-*/run-*.wandb")
    content = file.read_bytes()
    steps = [step for step in ("256", "512") if step.encode() in content]
    return content.decode("latin-1"), steps if b"train/return" in content else []


def mlflow_of(folder):
    with sqlite3.connect(folder / "mlflow.db") as base:
        settings = dict(base.execute("select key, value from params"))
        steps = base.execute("select step from metrics where key = 'train/return' order by step")
        return json.dumps(settings), [str(step) for (step,) in steps]


def trackio_of(folder):
    (file,) = Path("trackio").glob("coil-rl*.db")
    with sqlite3.connect(file) as base:
        settings = "".join(str(row) for row in base.execute("select * from configs"))
        rows = base.execute("select step, metrics from metrics").fetchall()
        return settings, sorted({str(step) for step, row in rows if b"train/return" in row})


READERS = {"csv": csv_of, "wandb": wandb_of, "mlflow": mlflow_of, "trackio": trackio_of}


@pytest.fixture
def alone(monkeypatch, tmp_path):
    """Keep what loggers write outside of the run, and their settings, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.setenv("WANDB_MODE", "offline")  # the logger sets it, too
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("logger", READERS)
def test_logged_run_holds_its_settings_and_is_evaluated_and_resumed_without_trust(logger, alone):
    if logger != "csv" and importlib.util.find_spec(logger) is None:
        pytest.skip(f"{logger} is not installed: python -m pip install 'coil-rl[{logger}]'")
    done = called("train", *QUICK, f"logger={logger}")
    assert "is left out" not in done.stderr
    settings, steps = READERS[logger](alone / "run")
    assert "learner.gamma" in settings
    assert steps == ["256", "512"]
    done = called("evaluate", "run=run", *TRACK, "evaluation.repeats=1", "hydra.run.dir=again")
    assert "ppo: mean test reward" in done.stdout
    done = called("train", "resume=run", "budget.frames=768")
    assert "ppo: mean test reward" in done.stdout
    assert "is left out" not in done.stderr
