import contextlib
import csv
import io
import logging
import sys
from pathlib import Path

import pytest
from PIL import Image
from run_folders import make_untrained_run

from coil_rl.programs import listen

TRACKS = ["track=generated", "track.test.count=1", "track.train.count=1"]
FEW = [*TRACKS, "evaluation.repeats=1", "donors=2"]
FILES = {
    "listening.csv", "listening.md", "listening.png", "listening_agreement.png", "listening_gradient.png",
    "listening_places.csv",
}  # fmt: skip


def make_run(folder, *overrides):
    return make_untrained_run(folder, *TRACKS, "env.time_limit=2", *overrides)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    make_run(folder / "coil", "method=coil", "guide=[spline,random]", "learner.action_gain=1.0")
    make_run(folder / "dqn", "method=coil", "learner=dqn")
    make_run(folder / "ppo", "method=ppo")
    make_run(folder / "guide", "method=guide")
    return folder


@pytest.fixture
def here(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    logging.getLogger().handlers.clear()


def outcome(*arguments):
    """Exit code, and what stands on standard output and error."""
    out, error, code, given = io.StringIO(), io.StringIO(), 0, sys.argv
    sys.argv = ["listen", *arguments]
    try:
        with contextlib.redirect_stderr(error), contextlib.redirect_stdout(out):
            listen.main()
    except SystemExit as end:
        code = end.code
    finally:
        sys.argv = given
    return code, out.getvalue(), error.getvalue()


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_listen_prints_the_table_and_leaves_maps_and_numbers(runs, here):
    code, out, _ = outcome(f"run={runs / 'coil'}", *FEW, "hydra.run.dir=found")
    assert code == 0
    assert {path.name for path in Path("found").iterdir() if path.is_file()} == FILES
    assert out.startswith((Path("found") / "listening.md").read_text())
    last = out.splitlines()[-1]
    assert last.startswith("coil listens most to ")
    assert last.endswith(f"; see {here / 'found'}")
    table = rows_of(Path("found") / "listening_places.csv")
    assert {row["guide"] for row in table} == {"spline", "random"}
    assert next(row["place"] for row in table if row["guide"] == "spline") == "everywhere"
    assert {row["guide"] for row in rows_of(Path("found") / "listening.csv")} == {"spline", "random"}
    for name in FILES:
        if name.endswith(".png"):
            with Image.open(Path("found") / name) as image:
                assert image.width == 1600


def test_an_agent_that_chooses_does_so_too_or_otherwise(runs, here):
    code, out, _ = outcome(f"run={runs / 'dqn'}", *FEW, "hydra.run.dir=found")
    assert code == 0
    assert out.splitlines()[-1].startswith("coil_dqn listens most to spline, which moves its action by")
    assert "gradient" not in out
    assert "The agent chooses: |a - g| and intervention are 0\nfor the same choice and 1.414 for any other." in out
    assert {path.name for path in Path("found").iterdir() if path.is_file()} == FILES - {"listening_gradient.png"}
    for row in rows_of(Path("found") / "listening.csv"):
        differing = float(row["agreement"]) / 2**0.5 * int(row["states"])
        assert differing == pytest.approx(round(differing), abs=1e-3)


@pytest.mark.slow
def test_all_numbers_come_out_again(runs, here):
    for folder in ("one", "other"):
        assert outcome(f"run={runs / 'coil'}", *FEW, f"hydra.run.dir={folder}")[0] == 0
    for name in ("listening.csv", "listening_places.csv", "listening.md"):
        assert (Path("one") / name).read_bytes() == (Path("other") / name).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "run must be given: write run=VALUE"),
        ("run=null", "run=null: field 'run' is not Optional"),
        ("run=nowhere", "run=nowhere is not the folder of a run: it has no config.yaml"),
        ("run={runs}/ppo", "has nobody to listen to: the policy does not read guide_action; it reads observation"),
        ("run={runs}/guide", "has no agent: its guide drives alone; give a run that sees advice"),
        ("run={runs}/coil donors=0", "donors=0 must be between 1 and 10000"),
        ("run={runs}/coil bin=0", "bin=0.0 must be between 0.1 and 100.0"),
        ("run={runs}/coil turn_radius=-1", "turn_radius=-1.0 must be between 0.5 and 1000.0"),
        ("run={runs}/coil donor=1", "no key donor; the configuration has"),
    ],
)
def test_mistakes_are_one_sentence_exit_code_2_and_leave_nothing(arguments, words, runs, here):
    code, _, error = outcome(*arguments.format(runs=runs).split(), *TRACKS)
    (sentence,) = error.splitlines()
    assert code == 2
    assert sentence.startswith("listen: ")
    assert words in sentence
    assert not list(here.iterdir())
