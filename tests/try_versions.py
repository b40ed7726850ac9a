"""Install the project with the floor and the ceiling of each range, run tests and a training.

`make test-versions` does it.

It takes minutes and gigabytes an environment, so it is no part of the tests; each is removed before
the next one. Interpreters are looked for on the PATH. Where one is missing, a version cannot be
installed or a training fails, the table says so.

    python tests/try_versions.py                    all environments
    python tests/try_versions.py --only 'torch 2.12' --tests tests/transforms
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
TESTS = ["tests/transforms", "tests/coil_rl/learners", "tests/coil_rl/programs/test_programs.py"]
# By name: the interpreter, and the versions that differ from the newest in range.
ENVIRONMENTS = {
    "torch 2.12": ("3.11", ["torch==2.12.*", "torchrl==0.14.1", "tensordict==0.14.3"]),
    "torch 2.13": ("3.11", ["torch==2.13.*"]),
    "torch 2.14": ("3.11", ["torch==2.14.*"]),
    "torch 2.15": ("3.11", ["torch==2.15.*"]),
    "Python 3.12": ("3.12", ["torch==2.13.*"]),
    "Python 3.13": ("3.13", ["torch==2.13.*"]),
}
TRAINING = ["method=coil", "budget.frames=65_536", "hydra.run.dir=run"]
COLUMNS = ["environment", "Python", "torch", "TorchRL", "tensordict", "tests", "training"]
SUMMARY = r"^(?:\d+ \w+,? ?)+"
REWARD = r"mean test reward (\S+),"


def floors() -> list[str]:
    """Return each dependency at the lowest version of its range."""
    lowest = []
    for text in PROJECT["dependencies"]:
        requirement = Requirement(text)
        (floor,) = (each.version for each in requirement.specifier if each.operator == ">=")
        if floor.count(".") < 2:  # 4 is 4.0, and its corrections
            floor = ".".join([*floor.split("."), "0"][:2]) + ".*"
        lowest.append(f"{requirement.name}=={floor}")
    return lowest


def run(command: list[str], cwd: Path) -> subprocess.CompletedProcess[str]:
    """Return what a command did, as text, where nothing but packages is imported."""
    env = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    env |= {"OMP_NUM_THREADS": "1"}
    return subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, check=False)


def row(*cells: str) -> str:
    """Return a line of the table."""
    return f"| {' | '.join(cells)} |"


def installed(interpreter: str, pins: list[str], place: Path) -> str | None:
    """Make an environment with a Python, as "3.12", and versions; return what went wrong."""
    python = shutil.which(f"python{interpreter}")
    if python is None or run([python, "--version"], ROOT).returncode:
        return f"Python {interpreter} is not on this machine"
    run([python, "-m", "venv", str(place)], ROOT)
    pip = [str(place / "bin" / "python"), "-m", "pip", "install", "-q"]
    done = run([*pip, *pins, "pytest", "hypothesis", f"{ROOT}[gym]"], ROOT)
    if not done.returncode:
        return None
    reason = [line for line in done.stderr.splitlines() if "ERROR" in line] or ["unknown"]
    return f"cannot be installed: {reason[0][:120]}"


def tried(name: str, place: Path, tests: list[str]) -> str:
    """Return the line of the table for an environment, and name failed tests on standard error."""
    python = str(place / "bin" / "python")
    info = run([python, "-m", "coil_rl.programs.info"], place).stdout
    versions = dict(line.split(maxsplit=1) for line in info.splitlines())
    shown = [versions[package] for package in ("python", "torch", "torchrl", "tensordict")]
    done = run([python, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests], ROOT)
    for line in done.stdout.splitlines():
        if line.startswith(("FAILED", "ERROR")):
            print(line, file=sys.stderr, flush=True)
    found = re.search(SUMMARY, (done.stdout.strip().splitlines() or [""])[-1])
    result = found[0].strip() if found else (done.stdout + done.stderr)[-120:]
    done = run([python, "-m", "coil_rl.programs.train", *TRAINING], place)
    reward = re.search(REWARD, done.stdout)
    return row(name, *shown, result, reward[1] if reward else done.stderr[-120:])


def main() -> None:
    """Try the environments and print the table, line by line."""
    parser = argparse.ArgumentParser(description="Try the floors and ceilings of all ranges.")
    parser.add_argument("--only", action="append", help="name of an environment")
    parser.add_argument("--tests", nargs="+", default=TESTS, help="for pytest")
    given = parser.parse_args()
    environments = {"floors": ("3.11", floors()), **ENVIRONMENTS}
    unknown = sorted(set(given.only or ()) - set(environments))
    if unknown:
        sys.exit(f"--only {', '.join(unknown)}: there are {', '.join(environments)}")
    print(row(*COLUMNS), row(*["---"] * len(COLUMNS)), sep="\n", flush=True)
    for name in given.only or environments:
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder, "venv")
            interpreter, pins = environments[name]
            wrong = installed(interpreter, pins, place)
            line = row(name, wrong) if wrong else tried(name, place, given.tests)
            print(line, flush=True)


if __name__ == "__main__":
    main()
