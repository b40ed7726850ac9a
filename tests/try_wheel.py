"""Test what a release consists of, away from the checkout: make test-wheel.

The sdist gives the same wheel as the checkout, and its tests can be collected. Then the wheel is
installed in a bare environment with the versions of constraints.txt, where `coil-demo` draws its
picture, and all tests that need no checkout are run from a folder that has nothing but them.

    python tests/try_wheel.py                 a new environment, which takes minutes and gigabytes
    python tests/try_wheel.py --site FOLDER   the packages of FOLDER, and only the wheel anew
    python tests/try_wheel.py -m '' -x        what is not known here is for pytest
"""

import argparse
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
import time
import zipfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
# Tests of what is not installed: of sources as files, of pages, of benchmarks and examples.
NEED_A_CHECKOUT = [
    "benchmarks",
    "docs",
    "examples",
    "test_contributing.py",
    "test_imports.py",
    "test_packaging.py",
    "test_readme.py",
    "test_style.py",
    "test_your_env.py",
]
EXTRAS = "gym,export,imitate,robot,tensorboard,tune"  # whose parts the tests use


def run(*command: str | Path, cwd: Path, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a command where nothing but packages is imported; by default a failure ends all."""
    env = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    options = {"check": True, "text": True} | options
    return subprocess.run([*map(str, command)], cwd=cwd, env=env, **options)


def built(folder: Path) -> tuple[Path, Path]:
    """Make the wheel of the checkout, and the unpacked sdist, which gives the same wheel."""
    build = [sys.executable, "-m", "build", "--no-isolation"]
    shutil.rmtree(ROOT / "build" / "lib", ignore_errors=True)  # or removed files are in the wheel
    run(*build, "--wheel", "--sdist", "--outdir", folder, cwd=ROOT, stdout=subprocess.DEVNULL)
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    with tarfile.open(sdist) as file:
        file.extractall(folder, filter="data")
    unpacked = sdist.with_name(sdist.name.removesuffix(".tar.gz"))
    again = folder / "again"
    run(*build, "--wheel", "--outdir", again, cwd=unpacked, stdout=subprocess.DEVNULL)
    here, there = contents(wheel), contents(again / wheel.name)
    if here != there:
        names = sorted({name for name, _ in here ^ there})
        sys.exit(f"the wheel of the sdist differs from that of the checkout: {', '.join(names)}")
    print(f"the sdist gives the {len(here)} files of the wheel", flush=True)
    return wheel, unpacked


def contents(wheel: Path) -> set[tuple[str, int]]:
    """Return the names and checksums of the files of a wheel."""
    with zipfile.ZipFile(wheel) as file:
        return {(info.filename, info.CRC) for info in file.infolist()}


def environment(place: Path, packages: list[str], site: str | None) -> Path:
    """Return the interpreter of a new environment, with a folder of all other packages or not."""
    run(sys.executable, "-m", "venv", place, cwd=place.parent)
    if site is not None:
        (own,) = place.glob("lib/python*/site-packages")
        (own / "others.pth").write_text(f"{Path(site).resolve()}\n")
        packages = ["--no-deps", "--force-reinstall", *packages]
    python = place / "bin" / "python"
    run(python, "-m", "pip", "install", "-q", *packages, cwd=place.parent)
    return python


def collected(unpacked: Path, place: Path) -> str:
    """Return how many tests of an sdist can be collected, installed as by `make venv`."""
    python = environment(place, ["-e", str(unpacked)], sysconfig.get_path("purelib"))
    pytest = [python, "-m", "pytest", "-q", "--collect-only"]
    done = run(*pytest, cwd=unpacked, check=False, stdout=subprocess.PIPE)
    if done.returncode:
        sys.exit(f"the tests of the sdist cannot be collected:\n{done.stdout[-2000:]}")
    return done.stdout.strip().splitlines()[-1]


def main() -> int:
    """Try sdist and wheel, and return the exit code of the tests."""
    parser = argparse.ArgumentParser(description="Test sdist and wheel away from the checkout.")
    parser.add_argument("--site", help="folder with the other packages")
    given, others = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        wheel, unpacked = built(folder)
        print(f"in the sdist: {collected(unpacked, folder / 'of_sdist')}", flush=True)
        # A test builds a package, for which the setuptools of a new environment are too old.
        tools = ["setuptools", "-c", str(ROOT / "constraints.txt")]
        others_too = [f"{wheel}[{EXTRAS}]", "pytest", "hypothesis"]
        packages = [*([str(wheel)] if given.site else others_too), *tools]
        python = environment(folder / "of_wheel", packages, given.site)
        bare = folder / "bare"
        shutil.copytree(ROOT / "tests", bare / "tests")
        # The settings of pytest are in pyproject.toml, which is no part of the package.
        shutil.copy(ROOT / "pyproject.toml", bare)
        start = time.perf_counter()
        run(python.with_name("coil-demo"), cwd=bare)
        print(f"coil-demo: {time.perf_counter() - start:.1f} s to the picture", flush=True)
        left_out = [f"--ignore=tests/{place}" for place in NEED_A_CHECKOUT]
        command = [python, "-m", "pytest", "-q", *left_out, *others]
        return run(*command, cwd=bare, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
