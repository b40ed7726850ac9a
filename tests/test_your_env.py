"""docs/your_env.md and its reference: their commands and Python blocks run, at toy size.

The other code of the reference is that of the package.
"""

import math
import re
import shlex
import sys
from pathlib import Path

import pytest
from outside_package.install import PROXY, SOURCE, TINY, install
from programs import ROOT, called, code_blocks, read_csv

PLANT, PATH, FROM_PYTHON = (block for _, block in code_blocks(ROOT / "docs" / "your_env.md"))
REFERENCE = ROOT / "docs" / "your_env_reference.md"
ALL_BLOCKS = code_blocks(REFERENCE)
(SEVERAL_AGENTS,) = (block for _, block in ALL_BLOCKS if "vmas" in block)
BLOCKS = [(language, block) for language, block in ALL_BLOCKS if block != SEVERAL_AGENTS]
PROGRAMS = [block for language, block in BLOCKS if language == "python" and "import" in block]
EXCERPTS = [block for language, block in BLOCKS if language and block not in PROGRAMS]
SHELL = "".join(block for language, block in BLOCKS if not language)
COMMANDS = [shlex.split(line, comments=True) for line in SHELL.splitlines()]
TOY = {
    "coil-train": TINY,
    "coil-evaluate": ["evaluation.cases=2"],
    "coil-listen": ["evaluation.repeats=1", "donors=2"],
    "coil-report": [],
    "coil-distill": PROXY,
    "coil-export": ["observations=50"],
}
EVALUATION = ["evaluation.cases=2", "evaluation.curve.num_envs=2", "evaluation.curve.points=1"]
FEW = ["budget.frames=2048", *EVALUATION]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the folder of the package, which is installed for this process."""
    folder = tmp_path_factory.mktemp("your_env")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(install(folder))
        yield folder / "source"


@pytest.fixture
def plant(tmp_path, monkeypatch):
    """Change to a folder with the plant of the page."""
    (tmp_path / "plant.py").write_text(PLANT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "plant", raising=False)
    return tmp_path


@pytest.mark.slow
def test_path_is_measure_tune_train_export(plant):
    lines = [shlex.split(line, comments=True) for line in PATH.splitlines()]
    first, measure, *commands = filter(None, lines)
    assert first == ["export", "PYTHONPATH=."]
    assert measure[0] == "coil-compare", "tests/coil_rl/comparison runs it"
    assert commands[0][2:6] == measure[1:5], "the same env and controller"
    for name, *arguments in commands:
        toy = FEW if name == "coil-train" else TOY[name]
        called(name.removeprefix("coil-"), *arguments, *toy, cwd=plant)
    rows = (plant / "outputs" / "tank" / "evaluation.csv").read_text().splitlines()
    assert {row.split(",")[0] for row in rows[1:]} == {"guide", "coil_anchored_sac"}
    assert (plant / "outputs" / "file" / "policy.onnx").is_file()


@pytest.mark.slow
def test_python_of_the_ten_minutes_runs(plant):
    program = FROM_PYTHON.replace("20_000", "2048").replace("cases=100", "cases=2")
    program = program.replace('"env.max_steps=60"', f'"env.max_steps=60", *{EVALUATION}')
    found: dict = {}
    exec(compile(program, "your_env.md", "exec"), found)
    assert 0 <= found["flow"][0] <= 20


@pytest.mark.parametrize(
    "block", EXCERPTS, ids=[block.splitlines()[0].strip() for block in EXCERPTS]
)
def test_excerpt_is_a_part_of_the_package(block):
    files = [file for file in SOURCE.rglob("*") if file.suffix in (".py", ".yaml", ".toml")]
    assert any(block in file.read_text() for file in files)


def test_files_of_the_package_that_are_named_are_there():
    for name in re.findall(r"`(thermostat/[\w/]+\.\w+)`", REFERENCE.read_text()):
        assert (SOURCE / name).is_file(), name


@pytest.mark.slow
@pytest.mark.parametrize("program", PROGRAMS, ids=["from Python", "parts", "checks", "Gymnasium"])
def test_python_runs_as_printed(program, folder, tmp_path, monkeypatch):
    assert len([line for line in program.splitlines() if line]) <= 11
    monkeypatch.chdir(tmp_path)
    program = program.replace("100_000", "1024").replace("200_000", "1280")
    program = program.replace("cases=50", "cases=2")
    program = program.replace(
        'folder="outputs/py")', f'folder="outputs/py", overrides={EVALUATION})'
    )
    found: dict = {}
    exec(compile(program, "your_env.md", "exec"), found)
    if "result" in found:
        assert [episode["steps"] for episode in found["result"].episodes] == [96] * 4


def test_several_agents_learn_as_printed():
    pytest.importorskip("vmas", reason="vmas is not installed")
    found: dict = {}
    exec(compile(SEVERAL_AGENTS, "your_env.md", "exec"), found)
    assert math.isfinite(found["metrics"]["loss_critic"])
    assert len(found["result"].episodes) == 64
    assert max(episode["steps"] for episode in found["result"].episodes) <= 100
    assert math.isfinite(found["result"].mean_reward)


def means_of(run):
    """Return the row of the means of each driver with deterministic actions."""
    rows = [row for row in read_csv(run / "evaluation.csv") if row["case"] == "mean"]
    return {row["driver"]: row for row in rows if row["actions"] == "deterministic"}


@pytest.mark.slow
def test_commands_run_in_the_order_of_the_page(folder):
    assert len(COMMANDS) == 13
    for name, *arguments in COMMANDS:
        called(name.removeprefix("coil-"), *arguments, *TOY[name], cwd=folder)
    outputs = folder / "outputs"
    guide, agent = means_of(outputs / "room").values()
    assert float(guide["reward"]) > 75 > 60 > float(agent["reward"])
    assert float(guide["in_band"]) > 0.7 > float(agent["in_band"])
    assert float(guide["completed"]) == 1
    assert 20 < float(guide["energy"]) < 96
    rewards = sorted(float(means_of(run)["guide"]["reward"]) for run in outputs.glob("train/*"))
    assert len(rewards) == 4
    assert rewards[1] > 75, "of each kind of controller"
    learned = float(means_of(outputs / "ppo")["ppo"]["reward"])
    assert rewards[0] == pytest.approx(learned), "of the policy that is a guide"
    pages = {path.relative_to(outputs).parts[0] for path in outputs.rglob("*.md")}
    assert pages >= {"room", "ppo", "sweep"}
    assert (outputs / "sweep" / "report.png").is_file()
    assert Path(outputs / "room" / "learning_curve.png").is_file()
