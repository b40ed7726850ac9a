import pytest
from programs import called, read_csv
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


def listen(run, cwd, folder="out"):
    """Return what the program prints about a run."""
    return called("listen", f"run={run}", *FEW, f"hydra.run.dir={folder}", cwd=cwd).stdout


@pytest.mark.slow
def test_listen_prints_the_table_and_writes_maps_and_numbers(runs, tmp_path):
    out = listen(runs / "coil", tmp_path)
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
    listen(runs / "anchored", tmp_path)
    page = (tmp_path / "out" / "listening.md").read_text()
    assert "holds each guide: spline 1.00, random 0.00." in page
    rows = read_csv(tmp_path / "out" / "listening_sections.csv")
    rows = [row for row in rows if row["section"] == "everywhere"]
    gradients = {row["guide"]: float(row["gradient"]) for row in rows}
    assert gradients["spline"] > 0.8
    assert gradients["random"] == 0


@pytest.mark.slow
def test_discrete_actions_are_equal_or_different(runs, tmp_path):
    out = listen(runs / "dqn", tmp_path)
    assert out.splitlines()[-1].startswith("coil_dqn depends most on spline: other advice of it")
    assert "gradient" not in out
    files = {path.name for path in (tmp_path / "out").iterdir() if path.is_file()}
    assert files == FILES - {"listening_gradient.png"}
    for row in read_csv(tmp_path / "out" / "listening.csv"):
        different = float(row["agreement"]) / 2**0.5 * int(row["states"])
        assert different == pytest.approx(round(different), abs=1e-3)


@pytest.mark.slow
def test_numbers_are_reproducible(runs, tmp_path):
    for folder in ("one", "other"):
        listen(runs / "coil", tmp_path, folder)
    for name in ("listening.csv", "listening_sections.csv", "listening.md"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "run must be given: write run=VALUE"),
        ("run={runs}/ppo", "the policy does not read guide_action; it reads observation"),
        ("run={runs}/guide", "has no agent, only a guide"),
        ("run={runs}/coil evaluation.sections.bin=0", "sections.bin=0 must be at least 0.1"),
    ],
)
def test_mistakes_are_one_sentence_with_exit_code_2_and_leave_no_file(
    arguments, message, runs, tmp_path
):
    words = [*arguments.format(runs=runs).split(), *TRACKS]
    (sentence,) = called("listen", *words, cwd=tmp_path, code=2).stderr.splitlines()
    assert sentence.startswith("listen: ")
    assert message in sentence
    assert not list(tmp_path.iterdir())
