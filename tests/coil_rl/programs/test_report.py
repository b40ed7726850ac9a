import csv
import math
from pathlib import Path

import pytest
from PIL import Image
from programs import TINY, called, program
from run_folders import driven, make_run, make_sweep

FILES = {"report.md", "report.csv", "report_tracks.csv", "report.png", "report_curves.png"}


@pytest.fixture
def sweep(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return make_sweep(Path("sweep"))


def outcome(*arguments):
    """Exit code, and what stands on standard output and error."""
    done = called("report", *arguments, code=None)
    return done.returncode, done.stdout, done.stderr


def everything():
    return {str(path) for path in Path().rglob("*")}


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_report_prints_the_page_and_leaves_everything_in_the_folder_and_nothing_else(sweep):
    before = everything()
    code, out, error = outcome("folder=sweep")
    assert (code, error) == (0, "")
    assert {Path(path) for path in everything() - before} == {sweep / name for name in FILES}
    assert out == (sweep / "report.md").read_text() + "report: see sweep\n"
    assert "better than ppo" in out
    last = "6 of 8 runs that have begun are finished; the command that began them goes on with the rest."
    assert out.splitlines()[-2:] == [last, "report: see sweep"]
    for name in ("report.png", "report_curves.png"):
        with Image.open(sweep / name) as image:
            assert image.width == 1600


def test_files_have_every_number_in_full(sweep):
    outcome("folder=sweep", "actions=both", "resamples=100", "seed=3")
    rows = {(row["actions"], row["driver"], row["advice"]): row for row in rows_of(sweep / "report.csv")}
    assert len(rows) == 7
    coil = rows["deterministic", "coil", ""]
    assert float(coil["iqm"]) == pytest.approx(571)
    assert float(coil["low"]) <= 571 <= float(coil["high"])
    assert (coil["improvement"], coil["needs_guide"], coil["guide"], coil["seeds"]) == ("0.0", "True", "guide", "3")
    assert float(rows["sampled", "coil", ""]["improvement"]) == 0.5
    assert math.isnan(float(rows["deterministic", "guide", ""]["low"]))
    tracks = {tuple(row.values())[:5]: row["reward"] for row in rows_of(sweep / "report_tracks.csv")}
    assert tracks["sampled", "ppo", "", "3", "b"] == "615.0"
    text = (sweep / "report.md").read_text()
    assert text.index("## Deterministic actions") < text.index("## Sampled actions")


def test_a_second_report_takes_the_place_of_the_first(sweep):
    first = outcome("folder=sweep")
    there = everything()
    assert outcome("folder=sweep") == first
    assert everything() == there


def test_several_folders_are_one_report_in_the_first(sweep):
    other = Path("other")
    make_run(
        other / "run",
        "residual",
        0,
        driven("guide", {"a": 500.0, "b": 600.0}) + driven("residual", {"a": 1.0, "b": 2.0}),
    )
    _, out, _ = outcome("folder=[other,sweep]", "against=coil")
    assert "| residual |" in out
    assert "better than coil" in out
    assert "7 of 9 runs that have begun are finished" in out
    assert {file.name for file in other.iterdir()} == FILES | {"run"}
    assert not FILES & {file.name for file in sweep.iterdir()}


def test_without_ppo_nothing_is_compared_with(sweep):
    _, out, _ = outcome("folder=[sweep/0_coil,sweep/1_coil]")
    assert "better than" not in out


def test_many_labels_and_guides_that_differ_get_a_picture_each(sweep):
    for place, label in enumerate("abcdefghi"):
        rows = driven("guide", {"a": 1.0}) + driven(label, {"a": 2.0})
        make_run(Path("many") / label, label, 0, rows)
        make_run(Path("differ") / label, label, 0, rows, guide=300.0 + place % 2)
    heights = {}
    for name, folder in {"two": "[many/a,many/b]", "differ": "[differ/a,differ/b]", "many": "many"}.items():
        assert outcome(f"folder={folder}")[0] == 0
        place = Path(folder.strip("[]").split(",")[0])
        with Image.open(place / "report_curves.png") as image:
            heights[name] = image.height
    assert heights["differ"] < heights["two"] < heights["many"]


def test_guides_alone_have_no_curves(sweep):
    run = make_run(Path("guides") / "zero", "zero", 0, driven("guide", {"a": 1.0}), needs_guide=None)
    (run / "metrics.csv").unlink()
    assert outcome("folder=guides", "against=guide")[0] == 0
    assert {file.name for file in Path("guides").iterdir()} == FILES - {"report_curves.png"} | {"zero"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "folder must be given: write folder=VALUE"),
        ("folder=nowhere", "folder=nowhere is not there"),
        ("folder=empty", "folder=empty holds no run of coil-train"),
        ("folder=[]", "folder=[] must be a folder, or a list of them"),
        ("folder=[sweep,3]", "must be a folder, or a list of them"),
        (
            "folder=[sweep/6_coil,sweep/7_ppo]",
            "is finished; go on with coil-train resume=sweep/6_coil, or give the command",
        ),
        (
            "folder=sweep against=pop",
            "against=pop is no label of a finished run; there are coil, ppo, guide; did you mean ppo?",
        ),
        (
            "folder=sweep actions=sample",
            "actions='sample' must be 'deterministic', 'sampled' or 'both'",
        ),
        ("folder=sweep resamples=0", "resamples=0 must be greater than or equal to 1"),
        ("folder=sweep resamples=many", "resamples=many: Value 'many' of type 'str' could not be converted to Integer"),
        ("folder=sweep seed=-1", "seed=-1 must be greater than or equal to 0"),
        ("foldr=sweep", "no key foldr; the configuration has folder, actions, against, resamples, seed"),
        (
            "folder=sweep +sed=1",
            "no key sed; the configuration has folder, actions, against, resamples, seed; did you mean seed?",
        ),
        ("-m folder=sweep,empty", "leave out -m, and give several folders as folder=[ONE,OTHER]"),
        ("folder=sweep,empty", "Ambiguous value for argument 'folder=sweep,empty'"),
    ],
)
def test_mistakes_are_one_sentence_exit_code_2_and_leave_nothing(arguments, words, sweep):
    Path("empty").mkdir()
    before = everything()
    code, _, error = outcome(*arguments.split())
    (sentence,) = error.splitlines()
    assert code == 2
    assert sentence.startswith("report: ")
    assert words in sentence
    assert everything() == before


def test_a_damaged_file_is_named(sweep):
    (sweep / "2_coil" / "evaluation.csv").write_text("driver,advice,actions,track,reward\ncoil,,sampled,a,")
    code, _, error = outcome("folder=sweep")
    assert code == 2
    assert error.startswith("report: sweep/2_coil/evaluation.csv is damaged (")


@pytest.mark.slow
def test_report_reads_what_coil_train_wrote(tmp_path):
    sweep = ["method=coil,ppo", "evaluation.gif=false", "hydra.sweep.dir=sweep"]
    program("train", "-m", *TINY, *sweep, cwd=tmp_path)
    done = program("report", "folder=sweep", "actions=both", cwd=tmp_path)
    assert "All 2 runs that have begun are finished." in done.stdout
    assert done.stderr == ""
    assert {file.name for file in (tmp_path / "sweep").iterdir()} > FILES
    assert {path.name for path in tmp_path.iterdir()} == {"sweep"}
    reward = {row["driver"]: float(row["mean"]) for row in rows_of(tmp_path / "sweep" / "report.csv")[:3]}
    for run in (tmp_path / "sweep").glob("*_seed0"):
        means = [row for row in rows_of(run / "evaluation.csv") if row["track"] == "mean" and not row["advice"]]
        guide, agent = means[0], means[1]
        assert reward["guide"] == pytest.approx(float(guide["reward"]))
        assert reward[agent["driver"]] == pytest.approx(float(agent["reward"]))
