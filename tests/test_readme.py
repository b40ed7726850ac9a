"""README.md: its files are there, its commands and its Python run, at toy size."""

import re
import shlex
import sys
from collections import Counter

import pandas
import pytest
from programs import ROOT, called, code_blocks, read_csv

from benchmarks.promise import verdict
from coil_rl.report.statistics import difference

README = (ROOT / "README.md").read_text()
BLOCKS = code_blocks(ROOT / "README.md")
CONTROLLER, PROGRAM = (block for language, block in BLOCKS if language == "python")
COMMANDS = [
    shlex.split(line)
    for _, block in BLOCKS
    for line in block.splitlines()
    if line.startswith("coil-")
]
TOY = {
    "coil-train": ["budget.frames=2048", "evaluation.cases=2", "evaluation.curve.num_envs=2"],
    "coil-export": ["observations=50"],
}
# What only somebody knows who has read the docs. Words in code, such as the name of a method, may.
UNEXPLAINED = ("frames", "kept polic", "anchored", "placebo", "brake", "holm", "proxy", "arm ")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Change to a folder with the controller of the README."""
    (tmp_path / "lean.py").write_text(CONTROLLER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "lean", raising=False)
    return tmp_path


def test_it_is_short():
    assert len(README.splitlines()) <= 135


def test_words_that_only_the_docs_explain_are_not_in_it():
    prose = re.sub(r"```.*?```|`[^`]*`|\]\([^)]*\)", "", README, flags=re.DOTALL).lower()
    assert [word for word in UNEXPLAINED if word in prose] == []


@pytest.mark.slow
def test_python_runs_as_printed(folder):
    program = PROGRAM.replace("60_000", "2048").replace("cases=100", "cases=2")
    found: dict = {}
    exec(compile(program, "README.md", "exec"), found)
    assert found["action"] in (0, 1)
    assert set(found["run"].evaluate(cases=2)["driver"]) >= {"guide"}


@pytest.mark.slow
def test_commands_run_as_printed(folder):
    measure, *others = COMMANDS  # tests/coil_rl/comparison runs the first
    assert measure[0] == "coil-compare"
    for name, *arguments in others:
        called(name.removeprefix("coil-"), *arguments, *TOY[name], cwd=folder)
    assert (folder / "outputs" / "file" / "policy.onnx").is_file()


TASKS = {
    "MountainCarContinuous": "mountain_car",
    "Pendulum": "pendulum",
    "a car between cones*": "cones",
    "a supply chain": "serial_inventory",
    "a microgrid with a battery": "energy_microgrid",
    "a chemical reactor": "reactor",
    "InvertedPendulum*": "inverted_pendulum",
    "InvertedDoublePendulum*": "double_pendulum",
    "Reacher*": "reacher",
}
ARMS = ("intact", "half", "reversed", "random")
RUNS = pandas.read_csv(ROOT / "docs" / "methods" / "promise_sac_runs.csv")


def promised(runs):
    """Return returns alone by learner, and guide, end and verdict by arm, of the rows of a task."""
    ends = runs.pivot_table(index="seed", columns=["method", "arm"], values="end")
    guides = runs.groupby("arm")["guide"].mean()
    alone = {learner: ends[learner, "alone"] for learner in ("ppo", "sac")}
    best = max(alone.values(), key=lambda each: each.mean())
    scale = abs(max(best.mean(), guides["intact"]) - guides["random"])
    arms = {}
    for arm in ARMS:
        end, other = ends["coil_anchored_sac", arm], best
        if guides[arm] > best.mean():
            other = best * 0 + guides[arm]
        interval = [100 * each / scale for each in difference(end.tolist(), other.tolist())[:3]]
        arms[arm] = guides[arm], end.mean(), verdict(*interval)
    return {learner: each.mean() for learner, each in alone.items()}, arms


def test_numbers_of_the_table_are_those_of_the_runs():
    rows = RUNS[RUNS["seed"] < 10]
    verdicts = Counter()
    for name, task in TASKS.items():
        [cells] = re.findall(rf"^\| {re.escape(name)}, [\d,]+ \|(.*)\|$", README, flags=re.M)
        ppo, sac, *pairs = cells.split("|")
        alone, arms = promised(rows[rows["task"] == task])
        check_number(ppo, alone["ppo"])
        check_number(sac, alone["sac"])
        verdicts.update(found for _, _, found in arms.values())
        for arm, pair in zip(("intact", "reversed", "random"), pairs, strict=True):
            guide, end = pair.split("→")
            check_number(guide, arms[arm][0])
            check_number(end.strip("* "), arms[arm][1])
            mark = {"gain": "**", "loss": "*", "even": ""}[arms[arm][2]]
            assert end.strip() == f"{mark}{end.strip('* ')}{mark}", (task, arm)
    counts = "{gain} gains, {even} even, {loss} losses".format_map(verdicts)
    assert f"**{counts}** in nine tasks" in README


def test_ten_other_seeds_have_the_numbers_of_their_runs():
    rows = RUNS[RUNS["seed"] >= 10]
    page = (ROOT / "docs" / "anchored_measured.md").read_text().partition("**Ten other seeds")[2]
    page = page.partition("\n- ")[0]
    verdicts = Counter()
    for task, runs in rows.groupby("task"):
        [cells] = re.findall(rf"^\| {task} \|(.*)\|$", page, flags=re.MULTILINE)
        ppo, sac, *pairs = cells.split("|")
        alone, arms = promised(runs)
        check_number(sac, alone["sac"])
        check_number(ppo, alone["ppo"])
        for arm, pair in zip(ARMS, pairs, strict=True):
            verdicts[arms[arm][2]] += 1
            guide, end = pair.partition(";")[0].split("→")
            check_number(guide, arms[arm][0])
            check_number(end.strip("* "), arms[arm][1])
    counts = "{gain} gains, {even} even, {loss} losses".format_map(verdicts)
    assert all(counts in " ".join(text.split()) for text in (README, page))


def test_verdicts_with_ppo_are_those_of_the_benchmark():
    table = read_csv(ROOT / "docs" / "guide_benchmark" / "rows.csv")
    verdicts = Counter(row["verdict"] for row in table if row["method"] == "coil_anchored")
    counts = re.findall(r"^\| (?:higher|not dist|lower).* \| (\d+) \|$", README, flags=re.M)
    assert [int(count) for count in counts] == [verdicts[each] for each in ("gain", "even", "loss")]


def check_number(shown, value):
    """Check that a number of the README is a value, rounded to its last digit."""
    digits = len(shown.strip().partition(".")[2])
    assert float(shown) == round(float(value), digits)
