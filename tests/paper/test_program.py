import json
import shlex
import shutil
from pathlib import Path

import pytest
from drives import drive as circle
from hydra import compose, initialize_config_module
from hydra.utils import instantiate
from programs import TINY, called, environment
from run_folders import driven, make_run

from coil_paper import conf, sweeps
from coil_paper.program import INDEX
from coil_paper.reproduce.result import check_pools
from coil_paper.reproduce.training import Figure22
from coil_rl import UserError
from coil_rl.report import read_runs


@pytest.fixture(autouse=True)
def here(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", environment(tmp_path)["PYTHONPATH"])  # of the sweeps


def outcome(*arguments):
    """Return the exit code, standard output and standard error."""
    done = called("reproduce", *arguments, code=None)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.slow
def test_results_write_pages_numbers_and_pictures_and_print_the_pages():
    code, out, _ = outcome("table=1", "figure=6", "hydra.run.dir=run")
    names, ends = ("table_1", "figure_6"), ("md", "csv", "png")
    made = {f"{name}.{end}" for name in names for end in ends}
    assert code == 0
    assert {path.name for path in Path("run").iterdir()} == made | {INDEX}
    pages = [Path("run", f"{name}.md").read_text() for name in names]
    assert out.startswith(f"{pages[0]}\n{pages[1]}\nreproduce: table_1, figure_6 made; see ")
    assert "Made by `coil-reproduce table=1 budget=paper` at commit `" in pages[0]


def test_every_figure_of_the_paper_is_either_reproduced_or_named():
    with initialize_config_module("coil_paper.conf", version_base="1.3"):
        config = compose("reproduce")
    named = [number for numbers in config.other_figures.values() for number in numbers]
    made = [
        int(name.removeprefix("figure_")) for name in config.results if name.startswith("figure_")
    ]
    assert sorted(named + made) == list(range(1, 33))


def test_options_reach_the_result_and_the_command_on_its_page():
    others = ["~results.table_5.worlds", "+results.table_4.labels=[]"]
    iterations = "results.figure_6.iterations=7"
    assert outcome("figure=6", iterations, *others, "hydra.run.dir=run")[0] == 0
    assert len(Path("run/figure_6.csv").read_text().splitlines()) == 1 + 8
    own = f"`coil-reproduce figure=6 budget=paper {iterations}`"
    assert own in Path("run/figure_6.md").read_text()
    everything = shlex.join(["coil-reproduce", "all=true", "budget=paper", iterations, *others])
    assert f"`{everything}` writes this file" in Path("run", INDEX).read_text()


@pytest.mark.slow
def test_a_further_result_is_requested_by_its_kind_and_name():
    mine = "+results.figure_of_mine={_target_: coil_paper.reproduce.toymaker.Figure6}"
    code, out, _ = outcome("figure=of_mine", mine, "hydra.run.dir=run")
    assert code == 0
    assert "Made by `coil-reproduce figure=of_mine" in out


@pytest.mark.slow
def test_results_md_collects_all_results_made_so_far():
    assert outcome("table=1", "budget=smoke")[0] == 0
    first = Path("outputs/reproduce/smoke/table_1.md").read_text()
    assert outcome("table=[1]", "figure=[6]", "budget=smoke")[0] == 0
    assert Path("outputs/reproduce/smoke/table_1.md").read_text() == first
    text = Path("outputs/reproduce/smoke/RESULTS.md").read_text()
    assert text.count("Smoke test at the smallest budget") == 1
    assert text.index("## Table 1") < text.index("## Figure 6") < text.index("## Not made yet")
    assert "- `coil-reproduce table=4 budget=smoke`" in text.split("## Not made yet")[1]


@pytest.mark.slow
def test_table_7_is_an_alias_of_table_6_and_recordings_need_no_runs():
    circle(Path("mine.mcap"), scans=250, odometry=True, commands=True)
    arguments = ["table=[6,7]", "results.table_6.recordings=[mine.mcap]"]
    code, out, _ = outcome(*arguments, "hydra.run.dir=run")
    assert code == 0
    assert "reproduce: table_6 made" in out
    assert {path.name for path in Path("run").iterdir()} == {
        f"table_6.{end}" for end in ("md", "csv", "png")
    } | {INDEX}
    text = Path("run", INDEX).read_text()
    assert text.count("## Table 6: the robot") == text.count("### Table 7, measured") == 1
    again, *_ = outcome("table=7", *arguments[1:], "hydra.run.dir=again")
    assert again == 0
    assert Path("again/table_6.csv").read_bytes() == Path("run/table_6.csv").read_bytes()


def test_runs_of_one_label_with_other_configurations_are_not_pooled(tmp_path):
    for seed, gamma in ((0, 0.9), (1, 0.9), (2, 0.99)):
        run = make_run(tmp_path / str(seed), "coil", seed, driven("coil", {"a": 1.0}))
        settings = json.loads((run / "config.yaml").read_text())
        (run / "config.yaml").write_text(json.dumps(settings | {"learner": {"gamma": gamma}}))
    runs = read_runs([tmp_path])
    result = Figure22(["one"], ["coil"], {"other": ["two"]})
    alike, differs = runs[:2], runs[2:]
    check_pools(result, {"one": alike, "two": differs})  # worlds are not pooled
    with pytest.raises(UserError, match=r"=one: the runs of coil differ in learner.gamma"):
        check_pools(result, {"one": runs, "two": []})


@pytest.mark.fast(5)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "nothing is requested; give one of table=1, table=4"),
        ("table=[1,3]", "table=3 does not exist; there are table=1, table=4"),
        ("claim=table_1", "claim=table_1 does not exist"),
        ("figure=3", "figure=3 is a diagram, which is not reproduced; there are table=1"),
        ("claim=tabular_coal", "did you mean claim=tabular_coil?"),
        ("tabel=1", "there is no key tabel"),
        ("table=1 results.table_1.tolerance=0", "results.table_1.tolerance=0 must be more than 0"),
        ("table=1 results.table_1._target_=builtins.dict", "builtins.dict makes dict, not Result"),
        ("table=1 budget=small", "budget=small must be one of smoke, paper, full"),
        ("table=1 budgets.paper.seeds=0", "budgets.paper.seeds=0 must be at least 1"),
        ("-m table=1,4", "leave out -m, and request several as in table=[1,4]"),
    ],
)
def test_a_mistake_is_one_sentence_and_leaves_no_file(arguments, message):
    code, _, error = outcome(*arguments.split())
    assert code == 2
    assert len(error.splitlines()) == 1
    assert message in error
    assert not list(Path().iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("budget", ["smoke", "full"])
def test_every_budget_fits_every_experiment(budget):
    with initialize_config_module("coil_paper.conf", version_base="1.3"):
        config = compose("reproduce", ["table=1"])
    results = instantiate(config.results, _convert_="all").values()
    chosen = config.budgets[budget]
    experiments = {name for result in results for name in result.experiments}
    plans = [
        sweeps.planned(name, [*chosen.every, *chosen.only.get(name, [])], range(chosen.seeds))
        for name in experiments
    ]
    files = Path(conf.__path__[0], "experiment").glob("*.yaml")
    assert experiments == {path.stem for path in files}
    assert set(chosen.only) <= experiments
    for plan in plans:
        assert len(set(plan.all_folders)) == len(plan.all_folders) >= chosen.seeds


@pytest.mark.slow
def test_a_figure_trains_its_runs_and_a_lost_run_again():
    choices = ["experiments=[paper]", "labels=[coil,ppo]"]
    tiny = [word for word in TINY if word != "env.rate=6"]  # the budget sets it by the preset
    arguments = ["figure=22", "budget=smoke", "~results.figure_22.worlds", f"train={tiny}"]
    arguments += [f"results.figure_22.{choice}" for choice in choices]
    assert outcome(*arguments)[0] == 0
    files = [Path("outputs/reproduce/smoke", f"figure_22.{end}") for end in ("md", "csv")]
    pages = [file.read_text() for file in files]
    evaluated = {path: path.stat().st_mtime_ns for path in Path().rglob("evaluation.csv")}
    assert len(evaluated) == 4
    assert "> **Smoke test at the smallest budget" in pages[0]
    assert "Training frames: 512 (coil, ppo)." in pages[0]
    lost = sorted(evaluated)[0]
    shutil.rmtree(lost.parent)
    code, _, error = outcome(*arguments, "hydra/launcher=basic")
    assert (code, "hydra/launcher=basic" in error) == (0, True)
    again = {path: path.stat().st_mtime_ns for path in Path().rglob("evaluation.csv")}
    assert {path for path in evaluated if evaluated[path] != again[path]} == {lost}
    assert [file.read_text() for file in files] == pages
