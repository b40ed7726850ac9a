import json
import signal
import subprocess
import time
from importlib import metadata

import pytest
from programs import SHORT_LAP, TINY, TRACK, called, command, environment

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
    assert files >= {
        "config.yaml",
        "versions.json",
        "metrics.csv",
        "evaluation.csv",
        "episodes.csv",
        "policy_last.pt",
        "lines.png",
        "lines.gif",
        "learning_curve.png",
    }
    begun = json.loads((folder / "run" / "versions.json").read_text())
    assert begun["torchrl"] == metadata.version("torchrl")


def test_evaluate_repeats_the_numbers_of_train(run):
    folder, trained = run
    again = called("evaluate", "run=run", *TRACK, "evaluation.repeats=1", STILL, cwd=folder)
    assert again.stdout.splitlines()[:-1] == trained.stdout.splitlines()[:-2]


@pytest.mark.slow
def test_guide_alone_can_be_trained_and_evaluated(tmp_path):
    words = [*SHORT_LAP, STILL, "method=guide", "guide=zero", "hydra.run.dir=run"]
    done = called("train", *words, cwd=tmp_path)
    assert "guide: mean test reward" in done.stdout
    assert not (tmp_path / "run" / "metrics.csv").exists()
    alone = called("evaluate", "guide=zero", *SHORT_LAP, STILL, "hydra.run.dir=alone", cwd=tmp_path)
    assert alone.stdout.splitlines()[:-1] == done.stdout.splitlines()[:-1]


def test_folder_with_a_run_is_refused(run):
    folder, _ = run
    done = called("train", *TINY, "hydra.run.dir=run", cwd=folder, code=2)
    (sentence,) = done.stderr.splitlines()
    assert sentence.startswith(
        f"train: {folder / 'run'} already holds a run; resume it with coil-train resume="
    )


def test_finished_run_prints_its_evaluation_again(run):
    folder, done = run
    before = {
        file: file.stat().st_mtime_ns for file in (folder / "run").iterdir() if file.name != ".lock"
    }
    again = called("train", "resume=run", cwd=folder)
    assert again.stdout == done.stdout
    assert {file: file.stat().st_mtime_ns for file in before} == before


@pytest.mark.slow
def test_run_stopped_during_its_evaluation_resumes_to_the_same_numbers(run, tmp_path):
    folder, _ = run
    train = command("train", *TINY, STILL, "logger=tensorboard", "hydra.run.dir=run")
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    first = subprocess.Popen(train, cwd=tmp_path, env=environment(tmp_path), **pipes)
    while first.poll() is None and not (tmp_path / "run" / "policy_last.pt").exists():
        time.sleep(0.01)
    first.send_signal(
        signal.SIGSTOP
    )  # its evaluation may take less time than the start of another process
    second = called("train", "resume=run", cwd=tmp_path, code=2)
    (sentence,) = second.stderr.splitlines()
    assert (
        sentence
        == f"train: another process is running in {tmp_path / 'run'}; wait until it ends, or end it"
    )
    first.terminate()
    first.send_signal(signal.SIGCONT)
    _, stderr = first.communicate(timeout=60)
    assert first.returncode == 130
    assert (
        stderr.splitlines()[-1]
        == f"train: interrupted; continue with: coil-train resume={tmp_path / 'run'}"
    )
    assert "guide=" in stderr
    assert "Warning" not in stderr
    assert "Traceback" not in stderr
    assert not (tmp_path / "run" / "evaluation.csv").exists()

    (tmp_path / "run").rename(tmp_path / "moved")
    called("train", "resume=moved", cwd=tmp_path)
    for name in (
        "metrics.csv",
        "evaluation.csv",
        "episodes.csv",
        "policy_last.pt",
    ):
        assert (tmp_path / "moved" / name).read_bytes() == (folder / "run" / name).read_bytes(), (
            name
        )
    assert not (tmp_path / "run").exists(), "the logger wrote into the old folder"


@pytest.mark.parametrize(
    ("name", "arguments", "words"),
    [
        (
            "evaluate",
            ["run=/nowhere"],
            "run=/nowhere is not the folder of a run: it has no config.yaml",
        ),
        (
            "train",
            ["-m", "resume=run,other"],
            "resume=run,other takes no argument but trust=[PACKAGE], budget.frames=NUMBER, "
            "env.workers=NUMBER and changed=accept: the run has its own config.yaml; leave out -m",
        ),
    ],
)
def test_folder_without_a_run_is_refused(name, arguments, words, tmp_path):
    done = called(name, *arguments, cwd=tmp_path, code=2)
    assert done.stderr == f"{name}: {words}\n"
    assert not list(tmp_path.iterdir())


def test_info_prints_versions(tmp_path):
    out = called("info", cwd=tmp_path).stdout
    for name in ("python", "coil-rl", "torch ", "torchrl", "hydra-core", "commit"):
        assert name in out


@pytest.mark.slow
def test_part_of_another_package_is_used_by_its_name(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "their_package.py").write_text(
        "from coil_rl.guides import ConstantGuide\n\n\nclass TheirGuide(ConstantGuide):\n"
        "    def __init__(self, angle):\n        super().__init__(angle / 80)\n"
    )
    experiments = tmp_path / "conf" / "experiment"
    experiments.mkdir(parents=True)
    (experiments.parent / "guide").mkdir()
    (experiments.parent / "guide" / "theirs.yaml").write_text(
        "# @package guide.theirs\n_target_: their_package.TheirGuide\nangle: 80\n"
    )
    (experiments / "mine.yaml").write_text(
        "# @package _global_\ndefaults:\n  - override /method: guide\n  - override /guide: theirs\n"
    )
    mine = ["--config-dir", "conf", *SHORT_LAP, STILL, "+experiment=mine", "hydra.run.dir=run"]
    done = called("train", *mine, cwd=tmp_path)
    assert "100%" in done.stdout, "a constant steering of 80 degrees crashes every car"
