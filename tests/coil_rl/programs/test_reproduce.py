import shutil
from pathlib import Path

import pytest
from drives import drive as circle
from hydra import compose, initialize_config_module
from hydra.utils import instantiate
from programs import TRACK, called, program
from run_folders import driven, make_run

from coil_rl.programs import sweeps
from coil_rl.programs.reproduce import ALL


@pytest.fixture(autouse=True)
def here(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)


def outcome(*arguments):
    """Exit code, and what stands on standard output and error."""
    done = called("reproduce", *arguments, code=None)
    return done.returncode, done.stdout, done.stderr


def test_results_leave_their_pages_numbers_and_pictures_and_print_the_pages():
    code, out, _ = outcome("table=1", "figure=6", "hydra.run.dir=run")
    files = {path.name for path in Path("run").iterdir()}
    made = {f"{name}.{ending}" for name in ("table_1", "figure_6") for ending in ("md", "csv", "png")}
    assert code == 0
    assert files == made | {"RESULTS.md"}
    pages = [Path("run", f"{name}.md").read_text() for name in ("table_1", "figure_6")]
    end = f"reproduce: table_1, figure_6 made; see {Path('run').absolute() / 'RESULTS.md'}"
    assert out == f"{pages[0]}\n{pages[1]}\n{end}\n"
    assert "Made by `coil-reproduce table=1 budget=paper` at commit `" in pages[0]


def test_a_choice_of_a_result_reaches_it_and_its_page():
    of_another = ("~results.table_5.worlds", "+results.table_4.labels=[]")
    assert outcome("figure=6", "results.figure_6.iterations=7", *of_another, "hydra.run.dir=run")[0] == 0
    assert len(Path("run/figure_6.csv").read_text().splitlines()) == 1 + 8
    assert "`coil-reproduce figure=6 budget=paper results.figure_6.iterations=7`" in Path("run/figure_6.md").read_text()
    text = Path("run/RESULTS.md").read_text()
    everything = "results.figure_6.iterations=7 '~results.table_5.worlds' '+results.table_4.labels=[]'"
    assert f"`coil-reproduce all=true budget=paper {everything}` writes this file" in text
    assert "- `coil-reproduce table=1 budget=paper`" in text


def test_a_result_with_a_word_for_a_number_is_asked_for_by_its_kind():
    mine = "+results.figure_of_mine={_target_: coil_rl.reproduce.Figure6}"
    code, out, _ = outcome("figure=of_mine", mine, "hydra.run.dir=run")
    assert code == 0
    assert "Made by `coil-reproduce figure=of_mine" in out
    assert "claim=figure_of_mine cannot be made" in outcome("claim=figure_of_mine", mine)[2]


def test_all_results_that_were_made_come_together_whatever_asked_for_them():
    assert outcome("table=1", "budget=smoke")[0] == 0
    first = Path("outputs/reproduce/smoke/table_1.md").read_text()
    assert outcome("table=1", "budget=smoke")[0] == 0
    assert Path("outputs/reproduce/smoke/table_1.md").read_text() == first
    assert outcome("table=[1]", "figure=[6]", "budget=smoke")[0] == 0
    text = Path("outputs/reproduce/smoke/RESULTS.md").read_text()
    assert text.count("This is a smoke test") == 1
    assert "## Table 1" in text
    assert "## Figure 6" in text
    assert "- `coil-reproduce table=4 budget=smoke`" in text.split("## Not made yet")[1]
    assert "The guide's row of table 5" in text


def test_table_7_is_on_the_page_of_table_6_and_recordings_need_no_runs():
    circle(Path("mine.mcap"), scans=250, odometry=True, commands=True)
    asked = ["table=[6,7]", "results.table_6.recordings=[mine.mcap]"]
    code, out, _ = outcome(*asked, "hydra.run.dir=run")
    assert code == 0
    assert "reproduce: table_6 made" in out
    assert {path.name for path in Path("run").iterdir()} == {f"table_6.{end}" for end in ("md", "csv", "png")} | {ALL}
    text = Path("run", ALL).read_text()
    assert text.count("## Table 6: the robot") == text.count("### Table 7, measured") == 1
    assert "`coil-reproduce table=6 budget=paper 'results.table_6.recordings=[mine.mcap]'`" in text
    again, *_ = outcome("table=7", *asked[1:], "hydra.run.dir=again")
    assert again == 0
    assert Path("again/table_6.csv").read_bytes() == Path("run/table_6.csv").read_bytes()


@pytest.fixture
def two_runs(monkeypatch):
    """The runs of COIL and PPO that a figure asks for are there; what else is started is noted."""
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        sweep = sweeps.planned("paper", [], [0])
    for folder, label in zip(sweep.all_folders, ("coil", "ppo"), strict=True):
        make_run(folder, label, 0, driven("guide", {"a": 1.0}) + driven(label, {"a": 2.0}))
    started = []

    def start(words):
        started.append(words)
        return 3

    monkeypatch.setattr(sweeps, "start", start)
    return sweep, started


def test_runs_that_are_there_are_used_and_one_that_is_gone_is_done_again_alone(two_runs):
    sweep, started = two_runs
    choices = ["experiments=[paper]", "labels=[coil,ppo]"]
    asked = ["figure=22", "budgets.paper.seeds=1", *(f"results.figure_22.{choice}" for choice in choices)]
    code, out, _ = outcome(*asked)
    assert (code, started) == (0, [])
    assert "2 runs with the seeds 0, done at commit `unknown`. Frames of training: 20,000 (coil, ppo)." in out
    assert outcome(*asked)[1] == out
    (sweep.all_folders[1] / "evaluation.csv").unlink()
    code, _, error = outcome(*asked, "hydra/launcher=basic")
    assert code == 2
    assert "the sweep of paper ended with exit code 3" in error
    (command,) = started
    assert command == ["-m", "+experiment=paper", "seed=0", "hydra/launcher=basic"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "nothing is asked for; give one of table=1, table=4"),
        ("table=3", "table=3 cannot be made; there are table=1, table=4"),
        ("table=[1,3]", "table=3 cannot be made; there are table=1, table=4"),
        ("claim=table_1", "claim=table_1 cannot be made"),
        ("figure=line", "did you mean figure=lines?"),
        ("table=one", "table=one cannot be made; there are table=1"),
        ("tabel=1", "there is no key tabel"),
        ("+other=1", "there is no key other"),
        ("table=1 results.table_1.tolerance=0", "results.table_1: tolerance=0 must be more than 0"),
        ("table=1 +results.table_1.x=0", "results.table_1: Table1 takes no x; it takes tolerance"),
        (
            "table=1 results.table_1._target_=builtins.dict results.table_1.tolerance=1",
            "builtins.dict makes dict, not Result",
        ),
        ("table=1 budget=small", "budget=small must be one of smoke, paper, full"),
        ("table=1 budgets.paper.seeds=0", "budgets.paper.seeds=0 must be greater than or equal to 1"),
        ("-m table=1,4", "leave out -m, and ask for several as in table=[1,4]"),
    ],
)
def test_a_mistake_is_one_sentence_and_leaves_nothing(arguments, words):
    code, _, error = outcome(*arguments.split())
    assert code == 2
    assert len(error.splitlines()) == 1
    assert words in error
    assert not list(Path().iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("budget", ["smoke", "full"])
def test_what_a_budget_gives_fits_every_experiment_that_results_name(budget):
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        config = compose("reproduce", ["table=1"])
        results, given = instantiate(config.results, _convert_="all").values(), config.budgets[budget]
        experiments = {name for result in results for name in result.experiments}
        plans = [
            sweeps.planned(name, [*given.every, *given.only.get(name, [])], range(given.seeds)) for name in experiments
        ]
    folders = [folder for plan in plans for folder in plan.all_folders]
    assert len(experiments) == 7
    assert set(given.only) <= experiments
    assert len(folders) == len(set(folders)) == 15 * given.seeds


@pytest.mark.slow
def test_a_figure_from_nothing_and_again_after_one_run_was_lost():
    choices = ["experiments=[paper]", "labels=[coil,ppo]"]
    tiny = [*TRACK, "budget.frames=512", "budget.cars=8"]
    asked = ["figure=22", "budget=smoke", *(f"results.figure_22.{choice}" for choice in choices), f"train={tiny}"]
    program("reproduce", *asked, cwd=Path())
    pages = [Path(f"outputs/reproduce/smoke/{name}").read_text() for name in ("figure_22.md", "figure_22.csv")]
    judged = {path: path.stat().st_mtime_ns for path in Path().rglob("evaluation.csv")}
    assert len(judged) == 4
    assert "> **This is a smoke test" in pages[0]
    lost = sorted(judged)[0]
    shutil.rmtree(lost.parent)
    program("reproduce", *asked, cwd=Path())
    again = {path: path.stat().st_mtime_ns for path in Path().rglob("evaluation.csv")}
    assert {path for path in judged if judged[path] != again[path]} == {lost}
    assert [Path(f"outputs/reproduce/smoke/{name}").read_text() for name in ("figure_22.md", "figure_22.csv")] == pages
