"""Signals, closed streams and failing jobs: what was learned is kept, and the others go on."""

import io
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from functools import partial

import pytest
from programs import TINY, called, command, environment, program

from coil_rl.programs import app
from coil_rl.run import checkpoint, stopping
from coil_rl.run.folder import is_evaluated, locked

SMALL = [*TINY, "evaluation.gif=false", "method=ppo", "learner.epochs=1"]
LONG = [*SMALL, "budget.frames=200_000", "checkpoint_every=10_000"]


def _heed(number):
    plain = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    signal.signal(number, plain)


@pytest.mark.slow
@pytest.mark.parametrize(
    "number",
    [signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP],
    ids=lambda number: number.name,
)
def test_signal_saves_the_present_update_and_says_how_to_go_on(tmp_path, number):
    folder = tmp_path / "a run"
    process = subprocess.Popen(
        command("train", *LONG, f"hydra.run.dir='{folder}'"),
        cwd=tmp_path,
        env=environment(tmp_path),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        # As in a terminal: under nohup the tests ignore SIGHUP, and so would the program.
        preexec_fn=partial(_heed, number),
    )
    log = folder / "metrics.csv"
    deadline = time.monotonic() + 120
    while not log.exists() or log.read_bytes().count(b"\n") < 4:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(number)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130, error
    expected = shlex.join(["coil-train", f"resume={folder}"])
    assert error.splitlines()[-1] == f"train: interrupted; continue with: {expected}"
    state = checkpoint.load(folder / "checkpoint.pt")
    assert state["updates"] == log.read_bytes().count(b"\n") - 2


def test_training_stops_after_its_update_unless_it_is_asked_twice():
    stop = stopping.Stop()
    assert not stop.ask()
    with stop.after_update():
        assert not stop.requested
        with stop.at_once():
            assert not stop.ask()
        stop.requested = False
        assert stop.ask()
        assert not stop.ask()
    assert not stop.ask()


@pytest.mark.slow
@pytest.mark.parametrize("streams", [">/dev/full 2>&-", ">&- 2>&-", ">/dev/full 2>/dev/full"])
def test_closed_or_full_streams_do_not_end_a_training(tmp_path, streams):
    arguments = shlex.join(command("train", *SMALL, "hydra.run.dir=run"))
    done = subprocess.run(
        f"{arguments} {streams}", shell=True, cwd=tmp_path, env=environment(tmp_path), check=False
    )
    assert done.returncode == (2 if ">/dev/full" in streams else 0)  # a text was lost
    assert is_evaluated(tmp_path / "run")
    assert (tmp_path / "run" / "checkpoint.pt").exists()


def test_text_that_meets_a_full_disk_ends_a_program_with_an_error(monkeypatch, capsys):
    full = io.StringIO()
    monkeypatch.setattr(full, "flush", lambda: os.write(os.open("/dev/full", os.O_WRONLY), b"."))
    monkeypatch.setattr(sys, "stdout", full)
    with pytest.raises(SystemExit) as end, app.program("info"):
        print("a line")
    assert end.value.code == 2
    assert capsys.readouterr().err.startswith("info: the output cannot be used (No space left")


SWEEP = ["-m", *SMALL, "learner.gamma=7,0.9", "hydra.sweep.dir=sweep"]


@pytest.mark.slow
def test_failed_job_leaves_the_others_alone_and_the_same_command_goes_on(tmp_path):
    error = called("train", *SWEEP, cwd=tmp_path, code=2).stderr
    assert "1 job of this sweep failed: job 0" in error
    assert "gamma=7 must be at most 1" in error
    assert error.rstrip().endswith(shlex.join(["coil-train", *SWEEP]))
    (folder,) = [path for path in (tmp_path / "sweep").iterdir() if path.is_dir()]
    assert is_evaluated(folder)
    assert "gamma=7" in (tmp_path / "sweep" / "failed_jobs.txt").read_text()
    # Finished jobs are kept, one without an evaluation is finished.
    (folder / "evaluation.csv").unlink()
    checked = (folder / "checkpoint.pt").stat().st_mtime_ns
    error = called("train", *SWEEP, cwd=tmp_path, code=2).stderr
    assert is_evaluated(folder)
    assert (folder / "checkpoint.pt").stat().st_mtime_ns == checked
    called("train", *[each.replace("7,0.9", "0.9") for each in SWEEP], cwd=tmp_path)
    assert not (tmp_path / "sweep" / "failed_jobs.txt").exists()


@pytest.mark.slow
def test_sweep_whose_jobs_are_all_refused_names_the_reason_once_and_leaves_no_folder(tmp_path):
    sweep = ["-m", *SMALL, "learner.gamma=7", "seed=0,1", "hydra.sweep.dir=sweep"]
    last = called("train", *sweep, cwd=tmp_path, code=2).stderr.splitlines()[-1]
    assert "2 jobs of this sweep failed: jobs 0, 1: learner.gamma=7" in last
    assert last.count("gamma=7 must be at most 1") == 1
    assert not (tmp_path / "sweep").exists()


@pytest.mark.slow
@pytest.mark.parametrize("removed", [False, True])
def test_jobs_that_fail_in_two_programs_of_a_sweep_count_once(tmp_path, monkeypatch, removed):
    fail, folder = app.failed, tmp_path / "sweep"

    def fail_after_another_program(name, error):
        fail(name, error)
        if removed:
            shutil.rmtree(folder)
        return fail(name, error)

    monkeypatch.setattr(app, "failed", fail_after_another_program)
    sweep = ["-m", *SMALL, "learner.gamma=7", "hydra.sweep.dir=sweep"]
    error = called("train", *sweep, cwd=tmp_path, code=2).stderr
    assert "train: 1 job of this sweep failed: job 0" in error


@pytest.mark.slow
def test_job_that_another_process_works_on_is_left_to_it(tmp_path):
    folders = ["hydra.sweep.dir=sweep", "hydra.sweep.subdir=${hydra.job.num}"]
    with locked(tmp_path / "sweep" / "0"):
        done = called("train", "-m", *SMALL, "learner.gamma=0.8,0.9", *folders, cwd=tmp_path)
    said = re.search(r"train: job 0 \((.*)\) is left to the process that works on it", done.stderr)
    assert "learner.gamma=0.8" in said[1]
    assert not (tmp_path / "sweep" / "failed_jobs.txt").exists()
    assert not is_evaluated(tmp_path / "sweep" / "0")
    assert is_evaluated(tmp_path / "sweep" / "1")


@pytest.mark.slow
def test_failed_job_of_joblib_leaves_the_others_alone(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    launcher = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    done = program("train", *SWEEP, *launcher, cwd=tmp_path, code=2)
    assert "1 job of this sweep failed: job 0" in done.stderr
    (folder,) = [path for path in (tmp_path / "sweep").iterdir() if path.is_dir()]
    assert is_evaluated(folder)
