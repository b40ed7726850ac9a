"""The guide benchmark: its rows, their check, its pages, and the tasks of other packages."""

import json
import math
import shutil
from importlib.util import find_spec

import gymnasium
import pytest
from programs import ROOT, TINY_ARM, called, composed, read_csv, shipped
from run_folders import driven, make_run

from benchmarks.guide_benchmark import __main__ as program
from benchmarks.guide_benchmark.pages import by_method, summarised, write_all, write_task
from benchmarks.guide_benchmark.rows import (
    COLUMNS,
    VERSIONS,
    Reference,
    benchmark_rows,
    check_row,
    effort,
    fingerprint,
    read_rows,
    references,
)
from coil_rl.config.check import check
from coil_rl.errors import UserError
from coil_rl.report.runs import read_runs

pytest.importorskip("gymnasium.envs.classic_control")
PROGRAM = "guide_benchmark"
ROWS = ROOT / "docs" / "guide_benchmark" / "rows.csv"
FOREIGN = ROOT / "benchmarks" / "guide_benchmark" / "conf"
PACKAGES = {
    "energy_microgrid": "decisionrl",
    "inventory": "decisionrl",
    "reactor": "target_gym",
    "serial_inventory": "gym_invmgmt",
}
EXTRAS = {"babyai": "minigrid", "swimmer": "mujoco"}
IDS = {
    "mountain_car": "MountainCarContinuous-v0",
    "cart_pole": "CartPole-v1",
    "acrobot": "Acrobot-v1",
    "lunar_lander": "LunarLander-v3",
    "bipedal": "BipedalWalker-v3",
    "swimmer": "Swimmer-v5",
}


def intact():
    """Return a row of the documentation, of an intact guide."""
    return next(row for row in read_csv(ROWS) if row["arm"] == "intact")


def with_cells(row, changed):
    """Return a row with other cells; those that are None are left out."""
    return {name: cell for name, cell in (row | changed).items() if cell is not None}


def test_rows_of_the_table_are_valid():
    for row in read_csv(ROWS):
        check_row(row)  # an error names task and method


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"task": "chess"}, "no such task"),
        ({"end": "high"}, "a number is expected"),
        ({"end": "nan"}, "end must be known"),
        ({"score": "0.99"}, "score=0.99, but its other numbers give"),
        ({"effort": "headline"}, "effort=headline, but its other numbers give"),
        ({"verdict": "win"}, "verdict=win, but its other numbers give"),
        ({"fingerprint": "mine"}, "ten hexadecimal digits"),
        ({"lowest": "-inf"}, "no number infinite"),
        ({"seeds": "0"}, "must be above 0"),
        ({"torch": ""}, "versions of torch are missing"),
        ({"reached": "some"}, "a number is expected"),
        ({"reached": "99"}, "reached=99, but the row has"),
        ({"reached": "0"}, "reached=0, but frames_to_guide="),
        ({"low": "nan", "high": "nan"}, "but its other numbers give unknown"),
        ({"seconds": None}, "expected: task, method"),
        ({None: ["a further cell"]}, "expected: task, method"),
    ],
)
def test_row_that_contradicts_itself_is_refused(changed, message):
    with pytest.raises(ValueError, match=message):
        check_row(with_cells(intact(), changed))


@pytest.mark.parametrize(
    "changed",
    [{"low": "nan", "high": "nan", "verdict": "unknown"}, {"reached": None}, {"reached": ""}],
    ids=["no interval", "no column of those that reach the guide", "they were not counted"],
)
def test_row_may_lack_an_interval_and_the_seeds_that_reach_the_guide(changed):
    read = check_row(with_cells(intact(), changed))
    assert tuple(read) == COLUMNS
    assert read["reached"] is None or "low" in changed


def test_table_has_no_row_twice():
    keys = [tuple(row[name] for name in program.SAME) for row in read_csv(ROWS)]
    assert len(keys) == len(set(keys))


def test_effort_needs_both_seeds_and_frames():
    reference = Reference(frames=1000, level="guide", source="")
    assert effort(10, 950, reference) == "headline"
    assert effort(5, 1000, reference) == "standard"
    assert effort(4, 1000, reference) == effort(10, 500, reference) == "smoke"
    long = Reference(frames=1_000_000, level="guide", source="")
    assert effort(10, 60_000, long) == effort(5, 1_000_000, long) == "standard"
    assert effort(5, 50_000, long) == "smoke"


def test_fingerprint_is_that_of_the_configuration_without_its_seeds():
    one = {"seed": 0, "env": {"id": "A", "seed": 0}, "list": [{"seed": 0}]}
    other = {"seed": 1, "env": {"id": "A", "seed": 1}, "list": [{"seed": 1}]}
    assert fingerprint(one) == fingerprint(other) != fingerprint(one | {"label": "x"})


def test_every_task_has_a_reference_and_the_other_way_round():
    own = set(shipped("experiment/guide_benchmark"))
    others = {path.stem for path in (FOREIGN / "experiment/guide_benchmark").glob("*.yaml")}
    assert own | others == set(references())
    assert others == set(PACKAGES)


@pytest.mark.parametrize("task", IDS)
def test_reference_of_gymnasium_is_its_reward_threshold(task):
    assert float(references()[task].level) == gymnasium.spec(IDS[task]).reward_threshold


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One seed of PPO, and of kickstarting with two guides, in one task."""
    path = tmp_path_factory.mktemp("guide_benchmark")
    small = ["env.max_steps=15", *TINY_ARM, f"hydra.sweep.dir={path / 'pendulum'}", "seed=0"]
    for words in (["+arm=alone", "method=ppo"], ["+arm=intact,random", "method=kickstart"]):
        called("train", "-m", "+experiment=guide_benchmark/pendulum", *words, *small, cwd=path)
    return path


@pytest.mark.slow
def test_scores_are_0_for_the_random_guide_and_1_for_the_reference(folder):
    rows = benchmark_rows("pendulum", read_runs([folder / "pendulum"]))
    arms = {(row["method"], row["arm"]): row for row in rows}
    assert set(arms) == {("ppo", "alone"), ("kickstart", "intact"), ("kickstart", "random")}
    assert arms["kickstart", "intact"]["score_guide"] == pytest.approx(1)
    assert arms["kickstart", "random"]["score_guide"] == pytest.approx(0)
    assert math.isnan(arms["ppo", "alone"]["difference"])
    assert {row["effort"] for row in rows} == {"smoke"}
    assert all(tuple(row) == COLUMNS for row in rows)


@pytest.fixture
def made(tmp_path):
    """Three seeds of PPO and of two guides, of which one seed of PPO does not reach its guide."""
    for label, reward in (("ppo_alone", 200.0), ("coil_intact", 250.0), ("coil_random", 150.0)):
        guide = driven("guide", {"a": 10.0 if label == "coil_random" else 300.0})
        for seed in range(3):
            rows = guide + driven(label, {"a": reward + seed})
            rows += driven(label, {"a": 0.0}, advice="zeroed", crashed=1.0)
            level = 1000.0 if (label, seed) == ("ppo_alone", 2) else 300.0
            folder = make_run(tmp_path / label / str(seed), label, seed, rows, guide=level)
            (folder / "versions.json").write_text(json.dumps(dict.fromkeys(VERSIONS, "1")))
            (folder / "training_time.json").write_text('{"seconds": 1}')
    return tmp_path


def test_seeds_that_reach_the_guide_are_counted(made, tmp_path):
    runs = read_runs([made])
    rows = benchmark_rows("pendulum", runs)
    assert {row["method"] + row["arm"]: row["reached"] for row in rows} == {
        "ppoalone": 2,
        "coilintact": 3,
        "coilrandom": 3,
    }
    assert program.added(tmp_path / "rows.csv", rows) == rows
    write_task(tmp_path, "pendulum", rows)
    ladder = (tmp_path / "pendulum.md").read_text()
    mean = next(row["frames_to_guide"] for row in rows if row["method"] == "ppo")
    assert f" {mean:.0f} (2 of 3 seeds) |" in ladder
    assert ladder.count(" seeds)") == 1


@pytest.mark.slow
def test_page_names_the_returns_of_ppo_that_its_rows_are_compared_with(made, tmp_path):
    runs = read_runs([made])
    rows = benchmark_rows("pendulum", runs)
    row = next(row for row in rows if row["arm"] == "intact")

    def page(*others):
        write_task(tmp_path, "pendulum", [*rows, *others])
        return (tmp_path / "pendulum.md").read_text()

    alike, sac = row | {"ppo": row["ppo"] + 0.01}, row | {"method": "ibrl", "ppo": -936.39}
    assert "compared with PPO" not in page(alike)
    said = "is compared with PPO of its own sweep and seeds: rows of"
    assert f"{said} ibrl with -936.4; the others with 201.0.\n" in page(sac)
    half = row | {"arm": "half", "ppo": 5.0}
    assert f"{said} coil half with 5.0; rows of ibrl with -936.4; the others" in page(half, sac)


def test_row_is_of_the_seeds_that_ppo_has_too(made):
    shutil.rmtree(made / "ppo_alone" / "2")
    rows = benchmark_rows("pendulum", read_runs([made]))
    assert {row["seeds"] for row in rows} == {2}
    assert {row["end"] for row in rows} == {200.5, 250.5, 150.5}
    assert {row["ppo"] for row in rows} == {200.5}
    assert {row["failures"] for row in rows} == {0.0}  # those with the advice as it is


def test_versions_are_those_of_all_runs_of_a_row(made):
    file = made / "coil_intact" / "1" / "versions.json"
    file.write_text(json.dumps(dict.fromkeys(VERSIONS, "1") | {"commit": "2"}))
    rows = {row["arm"]: row for row in benchmark_rows("pendulum", read_runs([made]))}
    assert (rows["intact"]["commit"], rows["intact"]["torch"]) == ("1 / 2", "1")
    assert rows["random"]["commit"] == "1"
    file.unlink()
    with pytest.raises(UserError, match=r"there is no file .*versions.json; put back"):
        benchmark_rows("pendulum", read_runs([made]))


@pytest.mark.slow
def test_unknown_verdicts_have_a_column_only_if_there_are_any(tmp_path):
    rows = [row for row in read_rows(ROWS) if row["arm"] != "alone"]
    assert "unknown" not in write_all(tmp_path, rows)
    rows[0] |= {"verdict": "unknown", "low": math.nan, "high": math.nan}
    page = write_all(tmp_path, rows)
    assert page.count("| unknown |") == 2
    assert ", 1 unknown, " in page
    assert sum(row["unknown"] for row in summarised(rows)) == 1


def test_methods_are_ordered_by_their_share_of_losses_and_name_their_worst_pair():
    names = ("method", "task", "arm", "verdict", "difference")
    rows = [
        dict(zip(names, row, strict=True)) | {"score": 0.0, "lowest": math.nan}
        for row in [
            ("coil", "one", "intact", "loss", -9.0),
            ("coil", "one", "random", "even", 1.0),
            ("coil", "two", "intact", "even", 3.0),
            ("tune", "one", "intact", "loss", -2.0),
            ("ppo", "one", "alone", "", math.nan),
        ]
    ]
    coil, tune = by_method(rows)
    assert (coil["method"], coil["pairs"], coil["tasks"]) == ("coil", 3, 2)
    assert (coil["gain"], coil["even"], coil["loss"]) == (0, 2, 1)
    assert (coil["worst"], coil["where"]) == (-9.0, "one, intact")
    assert coil["difference"] == pytest.approx(-5 / 3)
    assert (tune["method"], tune["loss"]) == ("tune", 1)


@pytest.mark.slow
def test_program_writes_pages_and_rows_that_join_a_table(folder, tmp_path):
    file = tmp_path / "rows.csv"
    for _ in range(2):  # the second time each row replaces itself
        printed = called(PROGRAM, folder, "--pages", tmp_path, "--add", file).stdout
    rows = read_csv(file)
    assert len(rows) == 3
    for row in rows:
        check_row(row)
    page = (tmp_path / "README.md").read_text()
    assert page in printed
    assert "pendulum: 3 of 3 runs finished, 0 were refused" in printed
    assert "Smoke" in page
    assert (tmp_path / "all.png").exists()
    assert (tmp_path / "pendulum.webp").exists()


@pytest.mark.slow
def test_page_of_all_tasks_is_of_the_whole_table_that_rows_join(folder, tmp_path):
    file, pages, picture = tmp_path / "table.csv", tmp_path / "pages", "pendulum.webp"
    pages.mkdir()
    shutil.copyfile(ROWS, file)
    shutil.copyfile(ROWS.parent / picture, pages / picture)
    called(PROGRAM, folder, "--pages", pages, "--add", file)
    assert len(read_rows(file)) == len(read_rows(ROWS)) + 3
    assert (pages / "rows.csv").read_bytes() == file.read_bytes()
    page = (pages / "README.md").read_text()
    assert "acrobot, cart_pole" in page  # without a page here
    assert "[pendulum](pendulum.md)" in page
    task = (pages / "pendulum.md").read_text()
    assert f"({picture})" in task
    known = [row for row in read_rows(file) if row["task"] == "pendulum"]
    assert task.count("\n| ") == len(known) + 1  # the ladder has the rows of all sweeps
    assert (pages / picture).read_bytes() == (ROWS.parent / picture).read_bytes()


@pytest.mark.slow
def test_pages_of_the_docs_are_those_of_the_table(tmp_path):
    for file in (ROWS, *ROWS.parent.glob("*.webp")):
        shutil.copyfile(file, tmp_path / file.name)
    called(PROGRAM, "--pages", tmp_path, "--add", tmp_path / "rows.csv")
    for page in ROWS.parent.glob("*.md"):
        assert (tmp_path / page.name).read_text() == page.read_text(), page.name


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--pages", "pages"], "give the folder of the experiments"),
        (["."], "the task chess has no reference"),
    ],
)
def test_without_results_it_ends_with_one_sentence(words, message, made):
    shutil.copytree(made, made / "chess")
    assert message in called(PROGRAM, *words, cwd=made, code=2).stderr
    assert not (made / "pages").exists()


def jobs(task):
    """Return arm and method of some jobs of a task: each arm, and each method, at least once."""
    words = [f"+experiment=guide_benchmark/{task}"]
    params = composed(*words, return_hydra_config=True).hydra.sweeper.params
    arms, methods = (str(params[key]).split(",") for key in ("+arm", "method"))
    result = [(arm, methods[0]) for arm in arms] + [("intact", each) for each in methods[1:]]
    tuned = (ROOT / "conf" / "arm" / "tuned" / f"{task}.yaml").exists()
    return [*result, ("alone", "ppo"), *([(f"tuned/{task}", "tune")] if tuned else [])]


@pytest.mark.slow
@pytest.mark.parametrize("task", sorted(set(references()) - set(PACKAGES)))
def test_every_arm_and_every_method_of_a_task_can_be_started(task, tmp_path):
    if find_spec(EXTRAS.get(task, "torch")) is None:
        pytest.skip(f"{EXTRAS[task]} is not installed")
    for arm, method in jobs(task):
        words = [f"+experiment=guide_benchmark/{task}", f"+arm={arm}", f"method={method}"]
        check(composed(*words, f"run_dir={tmp_path}"))


@pytest.mark.slow
@pytest.mark.parametrize("task", PACKAGES)
def test_task_of_another_package_trains(task, tmp_path):
    if find_spec(PACKAGES[task]) is None:
        pytest.skip(f"{PACKAGES[task]} is not installed")
    place = "hydra.searchpath=[pkg://benchmarks.guide_benchmark.conf]"
    words = [f"+experiment=guide_benchmark/{task}", "+arm=intact", "method=coil", "seed=0"]
    words += [*TINY_ARM, f"hydra.sweep.dir={tmp_path}"]
    called("train", "-m", place, *words, cwd=tmp_path)
    assert (tmp_path / "coil_intact_seed0" / "evaluation.csv").exists()
