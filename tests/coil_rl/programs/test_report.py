import shutil
from pathlib import Path

import pytest
from programs import TINY, called, read_csv
from run_folders import driven, make_run, make_sweep

KINDS = ("", "_cases", "_curves")
FILES = {f"report{kind}.{end}" for kind in KINDS for end in ("csv", "png")}
FILES |= {"report.md", "report.html", "report.tex"}


@pytest.fixture
def sweep(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return make_sweep(Path("sweep"))


def report(*arguments):
    done = called("report", *arguments, code=None)
    return done.returncode, done.stdout, done.stderr


def all_files():
    return {str(path) for path in Path().rglob("*")}


@pytest.mark.slow
def test_report_prints_the_page_and_writes_its_files_again_and_again(sweep):
    before = all_files()
    code, out, error = report("folder=sweep")
    assert (code, error) == (0, "")
    after = all_files()
    assert {Path(path) for path in after - before} == {sweep / name for name in FILES}
    assert out == (sweep / "report.md").read_text() + "report: see sweep\n"
    assert "better than its guide" in out
    assert "6 of 8 runs that were started are finished" in out
    curves = read_csv(sweep / "report_curves.csv")
    assert (len(curves), list(curves[0])) == (120, ["env", "label", "seed", "frames", "return"])
    cases = read_csv(sweep / "report_cases.csv")
    found = {(row["driver"], row["advice"], row["case"]): row["reward"] for row in cases}
    assert found["ppo", "", "b"] == "641.0"
    tables = (sweep / "report.tex").read_text()
    assert tables.count(r"\bottomrule") == 3
    assert r"0\% to 71\%" in tables
    assert report("folder=sweep", "figures=pdf") == (code, out, error)
    pictures = {path for path in all_files() - after if path.endswith("pdf")}
    assert pictures == {f"sweep/report{kind}.pdf" for kind in KINDS}


@pytest.mark.slow
def test_several_folders_make_one_report_in_the_first(sweep):
    rows = driven("guide", {"a": 500.0, "b": 600.0}) + driven("residual", {"a": 1.0, "b": 2.0})
    make_run(Path("other/run"), "residual", 0, rows)
    _, out, _ = report("folder=[other,sweep]", "against=coil")
    assert "| residual |" in out
    assert "better than coil" in out
    assert "7 of 9 runs" in out
    assert {file.name for file in Path("other").iterdir()} == FILES | {"run"}
    assert not FILES & {file.name for file in sweep.iterdir()}
    (make_run(Path("guides/zero"), "zero", 0, rows[:3], needs_guide=None) / "metrics.csv").unlink()
    assert report("folder=guides", "against=guide")[0] == 0
    pictures = {"report_curves.png", "report_cases.png"}
    assert {file.name for file in Path("guides").iterdir()} == FILES - pictures | {"zero"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "folder must be given: write folder=VALUE"),
        ("folder=nowhere", "folder=nowhere does not exist"),
        ("folder=empty", "folder=empty holds no run of coil-train"),
        ("folder=[]", "folder=[] must be a folder, or a list of them"),
        ("folder=[sweep,3]", "must be a folder, or a list of them"),
        ("folder=[sweep/6_coil,sweep/7_ppo]", "continue one with coil-train resume=sweep/6_coil"),
        ("folder=sweep against=pop", "there are coil, ppo, guide; did you mean ppo?"),
        ("folder=sweep actions=sample", "must be 'deterministic', 'sampled' or 'both'"),
        ("foldr=sweep", "no key foldr; the configuration has folder, actions, against"),
        ("-m folder=sweep,empty", "leave out -m"),
        ("folder=damaged", "damaged/evaluation.csv is damaged ("),
    ],
)
def test_mistakes_are_one_sentence_with_exit_code_2_and_leave_no_file(arguments, message, sweep):
    Path("empty").mkdir()
    damaged = make_run(Path("damaged"), "coil", 0, None)
    (damaged / "evaluation.csv").write_text("driver,advice,actions,case,reward\ncoil,,sampled,a,")
    before = all_files()
    code, _, error = report(*arguments.split())
    (sentence,) = error.splitlines()
    assert code == 2
    assert sentence.startswith("report: ")
    assert message in sentence
    assert all_files() == before


def is_mean(row):
    return row["case"] == "mean" and not row["advice"]


@pytest.mark.slow
def test_report_reads_the_runs_of_coil_train(tmp_path):
    sweep = ["method=coil,ppo", "evaluation.gif=false", "hydra.sweep.dir=sweep"]
    called("train", "-m", *TINY, *sweep, cwd=tmp_path)
    done = called("report", "folder=sweep", "actions=both", cwd=tmp_path)
    assert "All 2 runs that were started are finished.\nreport:" in done.stdout
    assert done.stderr == ""
    assert {file.name for file in (tmp_path / "sweep").iterdir()} > FILES
    text = (tmp_path / "sweep" / "report.md").read_text()
    assert text.index("## Deterministic actions") < text.index("## Sampled actions")
    table = read_csv(tmp_path / "sweep" / "report.csv")[:3]
    reward = {row["driver"]: float(row["reward"]) for row in table}
    for run in (tmp_path / "sweep").glob("*_seed0"):
        guide, agent, *_ = (row for row in read_csv(run / "evaluation.csv") if is_mean(row))
        assert reward["guide"] == pytest.approx(float(guide["reward"]))
        assert reward[agent["driver"]] == pytest.approx(float(agent["reward"]))
    shutil.rmtree(run)  # as where the sweep was stopped before it
    left = called("report", "folder=sweep", cwd=tmp_path).stdout
    assert "Runs of the sweeps that were not started: 1; repeat their command." in left
