import json
import signal
import subprocess
import time
from importlib import metadata

import pytest
from programs import TINY, TRACK, called, command, environment

STILL = "evaluation.gif=false"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("train")
    return folder, called("train", *TINY, "hydra.run.dir=run", cwd=folder)


def test_train_prints_a_table_and_writes_all_files(run):
    folder, done = run
    lines = done.stdout.strip().splitlines()
    rows = [line.split("|")[1].strip() for line in lines if line.startswith("|")]
    assert rows[2:] == ["guide"] * 2 + ["coil"] * 4
    assert lines[-2].startswith("coil: mean test reward")
    assert f"coil-train resume={folder / 'run'} budget.frames=1024" in lines[-1]
    files = {file.name for file in (folder / "run").iterdir()}
    assert files >= {"config.yaml", "versions.json", "metrics.csv", "evaluation.csv"}
    assert files >= {"episodes.csv", "policy_last.pt", "lines.png", "lines.gif"}
    assert "learning_curve.png" in files
    begun = json.loads((folder / "run" / "versions.json").read_text())
    assert begun["torchrl"] == metadata.version("torchrl")


def test_evaluate_repeats_the_numbers_of_train(run):
    folder, trained = run
    again = called("evaluate", "run=run", *TRACK, "evaluation.repeats=1", STILL, cwd=folder)
    assert again.stdout.splitlines()[:-1] == trained.stdout.splitlines()[:-2]


def test_folder_with_a_run_is_refused(run):
    folder, _ = run
    done = called("train", *TINY, "hydra.run.dir=run", cwd=folder, code=2)
    said = f"train: {folder / 'run'} already holds a run; resume it with coil-train resume="
    assert done.stderr.startswith(said)


def test_finished_run_prints_its_evaluation_again(run):
    folder, done = run
    files = [file for file in (folder / "run").iterdir() if file.name != ".lock"]
    before = [file.stat().st_mtime_ns for file in files]
    again = called("train", "resume=run", cwd=folder)
    assert again.stdout == done.stdout
    assert [file.stat().st_mtime_ns for file in files] == before


@pytest.mark.slow
def test_run_stopped_during_its_evaluation_resumes_to_the_same_numbers(run, tmp_path):
    folder, _ = run
    train = command("train", *TINY, STILL, "logger=tensorboard", "hydra.run.dir=run")
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    first = subprocess.Popen(train, cwd=tmp_path, env=environment(tmp_path), **pipes)
    while first.poll() is None and not (tmp_path / "run" / "policy_last.pt").exists():
        time.sleep(0.01)
    # Its evaluation may take less time than the start of another process.
    first.send_signal(signal.SIGSTOP)
    second = called("train", "resume=run", cwd=tmp_path, code=2)
    run_dir = tmp_path / "run"
    assert second.stderr.startswith(f"train: another process is running in {run_dir}; wait until")
    first.terminate()
    first.send_signal(signal.SIGCONT)
    _, stderr = first.communicate(timeout=60)
    assert first.returncode == 130
    last = stderr.splitlines()[-1]
    assert last == f"train: interrupted; continue with: coil-train resume={run_dir}"
    assert "guide=" in stderr
    assert "Warning" not in stderr
    assert "Traceback" not in stderr
    assert not (tmp_path / "run" / "evaluation.csv").exists()

    (tmp_path / "run").rename(tmp_path / "moved")
    called("train", "resume=moved", cwd=tmp_path)
    for name in ("metrics.csv", "evaluation.csv", "episodes.csv", "policy_last.pt"):
        moved = (tmp_path / "moved" / name).read_bytes()
        assert moved == (folder / "run" / name).read_bytes(), name
    assert not (tmp_path / "run").exists(), "the logger wrote into the old folder"
