"""Help texts and wrong overrides need none of the heavy libraries, and help begins with examples."""

import subprocess
import sys
import tomllib

import pytest
from programs import ROOT, environment

HEAVY = {"torch", "torchrl", "tensordict", "sklearn", "matplotlib", "scipy", "pandas"}
SCRIPT = """
import importlib, sys
try:
    importlib.import_module("coil_rl.programs." + sys.argv.pop(1)).main()
finally:
    print("HEAVY", *sorted({HEAVY} & set(sys.modules)), file=sys.stderr)
"""
PROGRAMS = ["train", "evaluate", "distill"]


def start(cwd, *arguments):
    command = [sys.executable, "-c", SCRIPT.replace("{HEAVY}", repr(HEAVY)), *arguments]
    return subprocess.run(command, cwd=cwd, env=environment(cwd), capture_output=True, text=True, check=False)


@pytest.mark.parametrize("name", PROGRAMS)
def test_help_begins_with_examples_and_imports_nothing_heavy(name, tmp_path):
    done = start(tmp_path, name, "--help")
    assert done.stderr.splitlines()[-1] == "HEAVY"
    assert done.returncode == 0
    assert done.stdout.startswith(f"coil-{name}: ")
    assert done.stdout.count(f"  coil-{name} ") >= 3
    examples, groups, whole = (done.stdout.index(text) for text in (f"  coil-{name}", "\nguide: ", "\nbudget:\n"))
    assert examples < groups < whole


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["train", "lerner=x"], 2, "train: there is no key lerner; .*; did you mean learner?"),
        (["train", "learner=nope"], 2, "train: there is no learner=nope; learner can be a2c, dqn,"),
        (["evaluate", "evaluation.repeat=1"], 2, "evaluate: there is no key evaluation.repeat; evaluation has env,"),
        (["distill", "seed=abc"], 2, "distill: .*seed.*'abc'"),
        (["info"], 0, ""),
    ],
)
def test_wrong_override_is_refused_without_heavy_imports(arguments, code, message, tmp_path):
    done = start(tmp_path, *arguments)
    *lines, heavy = done.stderr.splitlines()
    assert heavy == "HEAVY"
    assert done.returncode == code
    assert len(lines) == (code == 2)
    assert all(part in done.stderr for part in message.split(".*"))
    assert not list(tmp_path.iterdir())


def test_every_program_has_a_help_text():
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    for script in set(scripts) - {"coil-info"}:
        name = script.removeprefix("coil-")
        assert f"    header: |\n      {script}: " in (ROOT / "conf" / f"{name}.yaml").read_text()
