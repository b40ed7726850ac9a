"""Install the project with the floor and the ceiling of each range, and run tests.

`make test-versions` does it.

It takes minutes and gigabytes an environment, so it is no part of the tests. Where an interpreter
is missing or a version cannot be installed, the table says so.

    python tests/try_versions.py                    all environments
    python tests/try_versions.py --only 'torch 2.12' --tests tests/transforms
"""

import argparse
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
SUMMARY = r"^(?:\d+ \w+,? ?)+"


def floors() -> list[str]:
    """Return each dependency at the lowest version of its range."""
    lowest = []
    for text in PROJECT["dependencies"]:
        requirement = Requirement(text)
        (floor,) = (each.version for each in requirement.specifier if each.operator == ">=")
        zeros = ".*" if floor.count(".") < 2 else ""
        lowest.append(f"{requirement.name}=={floor}{zeros}")
    return lowest


def run(command: list[str], cwd: Path) -> subprocess.CompletedProcess[str]:
    """Return what a command did, with its output as text."""
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


def tried(name: str, interpreter: str, pins: list[str], tests: list[str], folder: Path) -> str:
    """Return the line of the table for an environment.

    Args:
        name: of the environment.
        interpreter: its Python, as "3.12".
        pins: versions to install.
        tests: what pytest runs.
        folder: where the environment is made.
    """
    python = shutil.which(f"python{interpreter}")
    if python is None or run([python, "--version"], ROOT).returncode:
        return f"| {name} | - | Python {interpreter} is not on this machine |"
    place = folder / re.sub(r"\W", "_", name)
    run([python, "-m", "venv", str(place)], ROOT)
    own = str(place / "bin" / "python")
    pip = [own, "-m", "pip", "install", "-q", "--disable-pip-version-check"]
    done = run([*pip, *pins, "pytest", "hypothesis", f"{ROOT}[gym]"], ROOT)
    if done.returncode:
        reason = [line for line in done.stderr.splitlines() if "ERROR" in line] or ["unknown"]
        return f"| {name} | - | cannot be installed: {reason[0][:120]} |"
    versions = run([own, "-m", "coil_rl.programs.info"], folder).stdout
    shown = ", ".join(
        " ".join(line.split())
        for line in versions.splitlines()
        if line.split()[0] in ("torch", "torchrl", "tensordict")
    )
    done = run([own, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests], ROOT)
    found = re.search(SUMMARY, done.stdout.strip().splitlines()[-1])
    return f"| {name} | {shown} | {found[0].strip() if found else done.stdout[-120:]} |"


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
    print("| environment | versions | tests |\n| --- | --- | --- |", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in given.only or environments:
            print(tried(name, *environments[name], given.tests, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
