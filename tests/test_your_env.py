"""docs/your_env.md: its commands and Python blocks run, at toy size.

Its other code is that of the package, but for the file at its beginning.
"""

import math
import re
import shlex
from pathlib import Path

import pytest
from outside_package.install import PROXY, SOURCE, TINY, install
from programs import ROOT, called

PAGE = (ROOT / "docs" / "your_env.md").read_text()
ALL_BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```", PAGE, flags=re.DOTALL | re.MULTILINE)
PLANT, IN_ONE_FILE = (block for _, block in ALL_BLOCKS if "Tank" in block)
BLOCKS = [
    (language, block)
    for language, block in ALL_BLOCKS
    if "vmas" not in block and "Tank" not in block
]
(SEVERAL_AGENTS,) = (block for _, block in ALL_BLOCKS if "vmas" in block)
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
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the folder of the package, which is installed for this process."""
    folder = tmp_path_factory.mktemp("your_env")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(install(folder))
        yield folder / "source"


@pytest.mark.slow
def test_env_and_controller_in_one_file_are_enough(tmp_path, monkeypatch):
    (tmp_path / "plant.py").write_text(PLANT)
    monkeypatch.syspath_prepend(tmp_path)
    path, *commands = IN_ONE_FILE.splitlines()
    assert path == "export PYTHONPATH=."
    for name, *arguments in map(shlex.split, commands):
        called(name.removeprefix("coil-"), *arguments, *TOY[name], cwd=tmp_path)
    rows = (tmp_path / "outputs" / "tank" / "evaluation.csv").read_text().splitlines()
    assert {row.split(",")[0] for row in rows[1:]} == {"guide", "coil_anchored"}


@pytest.mark.parametrize(
    "block", EXCERPTS, ids=[block.splitlines()[0].strip() for block in EXCERPTS]
)
def test_excerpt_is_a_part_of_the_package(block):
    texts = [
        file.read_text() for file in SOURCE.rglob("*") if file.suffix in (".py", ".yaml", ".toml")
    ]
    assert any(block in text for text in texts)


def test_files_that_are_named_or_linked_are_there():
    for link in re.findall(r"\]\(([^)#]+)\)", PAGE):
        assert (ROOT / "docs" / link).exists(), link
    for name in re.findall(r"`(thermostat/[\w/]+\.\w+)`", PAGE):
        assert (SOURCE / name).is_file(), name


@pytest.mark.slow
@pytest.mark.parametrize("program", PROGRAMS, ids=["from Python", "parts", "checks", "Gymnasium"])
def test_python_runs_as_printed(program, folder, tmp_path, monkeypatch):
    assert len([line for line in program.splitlines() if line]) <= 11
    monkeypatch.chdir(tmp_path)
    for frames, toy in (("100_000", "2048"), ("200_000", "4096"), ("cases=50", "cases=2")):
        program = program.replace(frames, toy)
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


@pytest.mark.slow
def test_commands_run_in_the_order_of_the_page(folder):
    assert len(COMMANDS) == 15
    for name, *arguments in COMMANDS:
        toy = [] if any(argument.startswith("resume=") for argument in arguments) else TOY[name]
        called(name.removeprefix("coil-"), *arguments, *toy, cwd=folder)
    outputs = folder / "outputs"
    assert {path.parent.relative_to(outputs).parts[0] for path in outputs.rglob("*.md")} >= {
        "room",
        "ppo",
        "sweep",
    }
    assert (outputs / "sweep" / "report.png").is_file()
    assert Path(outputs / "room" / "learning_curve.png").is_file()
