"""`coil-compare` and `coil_rl.compare`: a pendulum, in the smallest trainings there are."""

import json
import shlex
import sys
import time
from pathlib import Path

import pytest
import torch
from programs import called, read_csv

import coil_rl
from coil_rl.comparison import jobs, timing
from coil_rl.report.runs import read_runs
from coil_rl.run.folder import locked

pytest.importorskip("gymnasium.envs.classic_control")
SMALL = ["env.max_steps=20", "budget={frames: 640, num_envs: 2, steps: 16, minibatches: 2}"]
SMALL += ["evaluation.cases=3", "evaluation.curve.num_envs=2", "evaluation.curve.points=2"]
TUNE = "tune={gain: [0.1, 10, log]}"
PENDULUM = ["env=pendulum", *SMALL, "minutes=0.01"]


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compare") / "a b,c=[d]{\u00e9}"
    done = called("compare", *PENDULUM, TUNE, f"folder={folder}")
    return folder, done


@pytest.mark.slow
def test_table_has_everything_that_acts(compared):
    folder, _ = compared
    rows = {row["policy"]: row for row in read_csv(folder / "compare.csv")}
    without = ["guide", "opposite", "zero", "random", "first network"]
    learned = ["tune", "ppo", "coil_anchored", "sac", "coil_anchored_sac"]
    assert list(rows) == [*without, *learned]
    assert all(rows[name]["seeds"] == "2" for name in learned)
    assert all(float(rows[name]["frames"]) == 0 for name in without)
    assert [float(rows[name]["frames"]) for name in ("ppo", "sac")] == [128, 640]
    assert float(rows["ppo"]["calls"]) == 0 < float(rows["tune"]["calls"])
    assert float(rows["guide"]["worst"]) <= float(rows["guide"]["return"])


@pytest.mark.slow
def test_it_says_before_what_it_runs_and_how_to_go_on(compared):
    folder, done = compared
    assert "ppo 128, coil_anchored 384, sac 640" in done.stderr
    assert "go on with: coil-compare env=pendulum" in done.stderr
    assert "minutes=0.01 is not enough" in done.stderr
    assert shlex.quote(f"folder={folder}") in done.stderr


@pytest.mark.slow
def test_verdict_is_a_file_for_programs(compared):
    folder, _ = compared
    found = json.loads((folder / "verdict.json").read_text())
    lines = (folder / "compare.md").read_text().splitlines()
    assert found["sentences"] == [line[3:] for line in lines[:3]]
    assert found["use"] in {row["policy"] for row in read_csv(folder / "compare.csv")} | {"nothing"}
    assert found["command"].startswith("coil-train env=pendulum")


@pytest.mark.slow
def test_page_has_three_sentences_and_a_command_that_composes(compared):
    folder, done = compared
    page = (folder / "compare.md").read_text()
    assert page in done.stdout
    assert [line[:3] for line in page.splitlines()[:3]] == ["1. ", "2. ", "3. "]
    assert "one step of delay on observation and action" in page or "random actions" in page
    program, *words = shlex.split(page.splitlines()[-1].partition(": ")[2])
    assert program == "coil-train"
    assert coil_rl.compose_train([*words, "run_dir=unused"]).env.id == "Pendulum-v1"


@pytest.mark.slow
def test_folder_is_one_for_reports_by_the_printed_command(compared):
    folder, done = compared
    assert (folder / "compare.png").stat().st_size > 10_000
    labels = {run.label for run in read_runs([folder]) if run.finished}
    assert {"tune", "ppo", "coil_anchored", "sac", "coil_anchored_sac"} <= labels
    program, *words = shlex.split(done.stdout.rpartition("; ")[2].removesuffix(" has more.\n"))
    assert program == "coil-report"
    page = called("report", *words, cwd=folder.parent).stdout
    assert "coil_anchored" in page


@pytest.mark.slow
def test_same_command_goes_on_without_repeating_anything(compared, monkeypatch):
    folder, _ = compared
    before = (folder / "compare.csv").read_text()
    (folder / "compare.csv").unlink()
    monkeypatch.setattr(coil_rl.Run, "train", None)
    done = called("compare", *PENDULUM, TUNE, f"folder={folder}")
    assert (folder / "compare.csv").read_text() == before
    assert "goes on" in done.stderr


@pytest.mark.slow
def test_other_arguments_in_the_same_folder_are_refused(compared):
    folder, _ = compared
    words = [*PENDULUM[:-1], "minutes=3", TUNE, f"folder={folder}"]
    assert "a comparison with minutes=0.01, not 3" in called("compare", *words, code=2).stderr
    words = [*PENDULUM, "env.fresh=true", TUNE, f"folder={folder}"]
    assert "a comparison with words=" in called("compare", *words, code=2).stderr


@pytest.mark.slow
def test_comparison_that_was_stopped_ends_with_the_same_table(compared, tmp_path, monkeypatch):
    folder, _ = compared
    job = jobs._run_job
    done = []

    def stopped(*given):
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(given)
        return job(*given)

    monkeypatch.setattr(jobs, "_run_job", stopped)
    words = [*PENDULUM, TUNE, f"folder={tmp_path / 'it'}"]
    assert "continue with: coil-compare" in called("compare", *words, code=130).stderr
    monkeypatch.undo()
    called("compare", *words)
    first, second = (read_csv(each / "compare.csv") for each in (folder, tmp_path / "it"))
    for one, other in zip(first, second, strict=True):
        for key in ("policy", "return", "worst", "frames", "calls"):
            assert one[key] == other[key]


class Lean:
    """Pushes to the wrong side of a pole that leans, and takes 1 ms for it."""

    def act(self, observation):
        time.sleep(0.001)
        return int(observation[2] < 0)


@pytest.mark.slow
def test_choices_have_no_sac_and_a_python_object_is_a_guide_that_is_reversed(tmp_path):
    longer = ["env.max_steps=60", SMALL[1], "evaluation.cases=10"]
    found = coil_rl.compare(
        "CartPole-v1", guide=Lean(), minutes=0.01, folder=tmp_path / "it", overrides=longer
    )
    assert found.verdict.wrong_way_round
    assert found.verdict.score < 0
    assert {"ppo", "coil_anchored"} <= set(found.table["policy"])
    assert not {"sac", "coil_anchored_sac"} & set(found.table["policy"])
    assert found.command.startswith("coil_rl.train(env, guide=guide, ")


class Fragile:
    """A controller that fails once a file exists."""

    last = Path()

    def act(self, observation):
        if Fragile.last.is_file():
            raise RuntimeError("no more")
        return [0.0]


@pytest.mark.slow
def test_failed_training_is_one_failed_training(tmp_path):
    Fragile.last = tmp_path / "it" / "ppo_seed1" / "evaluation.csv"
    words = [f"guide.controller.of={__name__}:Fragile", "guide=controller"]
    words += ["env=gym", "env.id=Pendulum-v1", *SMALL, "minutes=0.01", f"folder={tmp_path / 'it'}"]
    sys.path.insert(0, "tests/coil_rl/programs")
    done = called("compare", *words)
    rows = {row["policy"]: row for row in read_csv(tmp_path / "it" / "compare.csv")}
    assert rows["ppo"]["seeds"] == "2"
    assert "no more" in done.stderr
    assert any("failed: " in row["note"] for row in rows.values())
    assert "no more" in (tmp_path / "it" / "failed_jobs.txt").read_text()


@pytest.mark.fast(6)
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["env=pendulum", "guide=none"], "a comparison is about one guide, but there is none"),
        (["env=pendulum", "guide=[zero,random]"], "but there is zero, random"),
        (["env=pendulum", "method=ppo"], "method=ppo cannot be given to coil-compare"),
        (["env=pendulum", "learner=sac"], "learner=sac cannot be given to coil-compare"),
        (["env=pendulum", "-m"], "-m is no argument of coil-compare"),
        (["env=pendulum", "--config-dir", "nowhere"], "nowhere is no folder"),
        (["env=pendulum", "minutes=soon"], "minutes=soon must be a number"),
        (["env=pendulum", "minutes=0"], "minutes=0 must be above 0"),
        (["env=pendulum", "minutes"], "minutes: give minutes=VALUE"),
        (["env=pendulum", "seed=1.5"], "seed=1.5 must be a whole number"),
        (["env=pendulum", "learner.gama=1"], "learner.gama"),
        (["env=pendulum", "tune={gain: ["], "tune="),
        (["env=pendulum", "proxy.seed=3"], "nothing in this run reads proxy.seed"),
    ],
)
def test_mistake_is_one_sentence_and_writes_nothing(words, sentence, tmp_path):
    done = called("compare", *words, f"folder={tmp_path / 'it'}", cwd=tmp_path, code=2)
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "it").exists()


def test_second_process_is_refused_and_leaves_the_folder_of_the_first_one(tmp_path):
    folder = tmp_path / "it"
    with locked(folder):
        done = called("compare", *PENDULUM, f"folder={folder}", code=2)
        assert "another process is running in" in done.stderr
        assert (folder / ".lock").exists()


@pytest.mark.slow
def test_comparison_that_wrote_nothing_removes_what_it_made_only(tmp_path, monkeypatch):
    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(timing, "measure", stopped)
    (tmp_path / "empty").mkdir()
    for name in ("empty", "new/it"):
        called("compare", *PENDULUM, f"folder={tmp_path / name}", code=130)
    assert list(tmp_path.rglob("*")) == [tmp_path / "empty"]


def test_folder_that_is_a_file_is_said_to_be_one(tmp_path):
    (tmp_path / "it").write_text("mine")
    done = called("compare", *PENDULUM, f"folder={tmp_path / 'it'}", code=2)
    assert f"folder={tmp_path / 'it'} is a file; give a folder" in done.stderr
    assert (tmp_path / "it").read_text() == "mine"


@pytest.mark.slow
def test_steps_are_timed_with_the_threads_of_the_trainings(monkeypatch, tmp_path):
    threads = []

    def measured(*_):
        threads.append(torch.get_num_threads())
        raise KeyboardInterrupt

    monkeypatch.setattr(timing, "measure", measured)
    torch.set_num_threads(2)
    try:
        with pytest.raises(KeyboardInterrupt):
            coil_rl.compare("pendulum", guide="zero", overrides=SMALL, folder=tmp_path / "it")
        assert torch.get_num_threads() == 2, "of the caller"
    finally:
        torch.set_num_threads(1)
    assert threads == [1]
