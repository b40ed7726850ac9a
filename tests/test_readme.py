"""README.md: its files are there, its commands and its Python run, at toy size."""

import re
import shlex
import sys

import pytest
from programs import ROOT, called

README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```", README, flags=re.DOTALL | re.MULTILINE)
CONTROLLER, PROGRAM = (block for language, block in BLOCKS if language == "python")
COMMANDS = [
    shlex.split(line)
    for _, block in BLOCKS
    for line in block.splitlines()
    if line.startswith("coil-")
]
TOY = {
    "coil-train": ["budget.frames=2048", "evaluation.cases=2", "evaluation.curve.num_envs=2"],
    "coil-evaluate": ["evaluation.cases=2"],
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


def test_python_runs_as_printed(folder):
    program = PROGRAM.replace("60_000", "2048").replace("cases=100", "cases=2")
    found: dict = {}
    exec(compile(program, "README.md", "exec"), found)
    assert found["action"] in (0, 1)
    assert set(found["run"].evaluate(cases=2)["driver"]) >= {"guide"}


def test_commands_run_as_printed(folder):
    assert [command[0] for command in COMMANDS] == ["coil-train", "coil-evaluate"]
    for name, *arguments in COMMANDS:
        done = called(name.removeprefix("coil-"), *arguments, *TOY[name], cwd=folder)
        assert "guide" in done.stdout


def test_numbers_of_the_table_are_those_of_the_page_that_it_names():
    page = (ROOT / "docs" / "methods" / "coil_anchored.md").read_text()
    rows = re.findall(
        r"^\| (\w+) \| (\w+) \| \d+ \| ([-.\d]+) \| ([-.\d]+) \| ([-.\d]+)", page, re.M
    )
    measured = {(task, arm): [round(float(cell)) for cell in cells] for task, arm, *cells in rows}
    names = {"MountainCarContinuous": "mountain_car", "Pendulum": "pendulum", "Acrobot": "acrobot"}
    names |= {"CartPole, a poor rule": "cart_pole", "LunarLanderContinuous": "lunar_lander"}
    for name, task in names.items():
        [cells] = re.findall(rf"^\| {name} \|(.*)\|$", README, flags=re.M)
        alone, *pairs = cells.replace("*", "").split("|")
        assert int(alone) == measured[task, "intact"][1]
        for arm, pair in zip(("intact", "reversed", "random"), pairs, strict=True):
            guide, _, anchored = measured[task, arm]
            assert [int(cell) for cell in pair.split(",")] == [guide, anchored], (task, arm)
