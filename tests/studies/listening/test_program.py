import csv

import pytest
from programs import called
from run_folders import make_untrained_run

TRACKS = ["track=generated", "track.test.count=1", "track.train.count=1"]
FEW = [*TRACKS, "evaluation.repeats=1", "donors=2"]
FILES = {
    "listening.csv",
    "listening.md",
    "listening.png",
    "listening_agreement.png",
    "listening_gradient.png",
    "listening_sections.csv",
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    for name, *overrides in (
        ("coil", "method=coil", "guide=[spline,random]", "learner.action_gain=1.0"),
        ("dqn", "method=coil", "learner=dqn"),
        ("anchored", "method=coil_anchored", "guide=[spline,random]"),
        ("ppo", "method=ppo"),
        ("guide", "method=guide"),
    ):
        make_untrained_run(folder / name, *TRACKS, "env.time_limit=2", *overrides)
    return folder


def listen(cwd, *arguments, code=0):
    """Return standard output and standard error."""
    done = called("listen", *arguments, cwd=cwd, code=code)
    return done.stdout, done.stderr


def read_csv(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_listen_prints_the_table_and_writes_maps_and_numbers(runs, tmp_path):
    out, _ = listen(tmp_path, f"run={runs / 'coil'}", *FEW, "hydra.run.dir=out")
    folder = tmp_path / "out"
    assert {path.name for path in folder.iterdir() if path.is_file()} == FILES
    assert out.startswith((folder / "listening.md").read_text())
    assert out.splitlines()[-1].startswith("coil depends most on ")
    table = read_csv(folder / "listening_sections.csv")
    assert {row["guide"] for row in table} == {"spline", "random"}
    assert next(row["section"] for row in table if row["guide"] == "spline") == "everywhere"
    assert {row["guide"] for row in read_csv(folder / "listening.csv")} == {"spline", "random"}


@pytest.mark.slow
def test_page_of_an_anchored_agent_gives_the_weights_of_its_guides(runs, tmp_path):
    listen(tmp_path, f"run={runs / 'anchored'}", *FEW, "hydra.run.dir=out")
    assert (
        "Weight with which the policy holds each guide: spline 1.00, random 0.00."
        in (tmp_path / "out" / "listening.md").read_text()
    )
    everywhere = {
        row["guide"]: float(row["gradient"])
        for row in read_csv(tmp_path / "out" / "listening_sections.csv")
        if row["section"] == "everywhere"
    }
    assert everywhere["spline"] > 0.8
    assert everywhere["random"] == 0


@pytest.mark.slow
def test_discrete_actions_are_equal_or_different(runs, tmp_path):
    out, _ = listen(tmp_path, f"run={runs / 'dqn'}", *FEW, "hydra.run.dir=out")
    assert out.splitlines()[-1].startswith(
        "coil_dqn depends most on spline: other advice of it changes the action by"
    )
    assert "gradient" not in out
    files = {path.name for path in (tmp_path / "out").iterdir() if path.is_file()}
    assert files == FILES - {"listening_gradient.png"}
    for row in read_csv(tmp_path / "out" / "listening.csv"):
        different = float(row["agreement"]) / 2**0.5 * int(row["states"])
        assert different == pytest.approx(round(different), abs=1e-3)


@pytest.mark.slow
def test_numbers_are_reproducible(runs, tmp_path):
    for folder in ("one", "other"):
        listen(tmp_path, f"run={runs / 'coil'}", *FEW, f"hydra.run.dir={folder}")
    for name in ("listening.csv", "listening_sections.csv", "listening.md"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "run must be given: write run=VALUE"),
        (
            "run={runs}/ppo",
            "does not use advice: the policy does not read guide_action; it reads observation",
        ),
        ("run={runs}/guide", "has no agent, only a guide"),
        (
            "run={runs}/coil evaluation.sections.bin=0",
            "evaluation.sections.bin=0 must be at least 0.1",
        ),
    ],
)
def test_mistakes_are_one_sentence_with_exit_code_2_and_leave_no_file(
    arguments, message, runs, tmp_path
):
    _, error = listen(tmp_path, *arguments.format(runs=runs).split(), *TRACKS, code=2)
    (sentence,) = error.splitlines()
    assert sentence.startswith("listen: ")
    assert message in sentence
    assert not list(tmp_path.iterdir())
