"""Run the tests that need no checkout with a wheel in a bare environment: make test-wheel.

The tests are copied to a folder without the sources, so that nothing but the wheel is imported.

    python tests/try_wheel.py                   a new environment, which takes minutes and gigabytes
    python tests/try_wheel.py --site FOLDER     the packages of FOLDER, and only the wheel anew
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
# What a file of tests has that reads the sources, or something beside them.
OF_A_CHECKOUT = re.compile(r"\bROOT\b|parents\[|pyproject|conf/|run_folders\.py")
OTHERS = ("benchmarks", "docs", "examples", "paper")  # folders of tests of what is not installed


def without_checkout(tests: Path) -> list[str]:
    """Return the files of tests that need no checkout."""
    found = []
    for path in sorted(tests.rglob("test_*.py")):
        place = path.relative_to(tests)
        text = path.read_text(encoding="utf-8")
        if place.parts[0] not in OTHERS and not OF_A_CHECKOUT.search(text):
            found.append(str(Path("tests", place)))
    return found


def environment(folder: Path, site: str | None) -> str:
    """Return the interpreter of an environment with the wheel.

    Args:
        folder: where it is made.
        site: folder with the other packages; None: they are installed.
    """
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    (wheel,) = folder.glob("*.whl")
    subprocess.run([sys.executable, "-m", "venv", str(folder / "venv")], check=True)
    python = str(folder / "venv" / "bin" / "python")
    packages = [f"{wheel}[gym]", "pytest", "hypothesis"]
    if site is not None:
        (own,) = (folder / "venv" / "lib").glob("python*/site-packages")
        (own / "others.pth").write_text(f"{Path(site).resolve()}\n")
        packages = ["--no-deps", "--force-reinstall", str(wheel)]
    pip = [python, "-m", "pip", "install", "-q", "--disable-pip-version-check"]
    subprocess.run([*pip, *packages], check=True)
    return python


def main() -> int:
    """Run the tests, and return the exit code of pytest."""
    parser = argparse.ArgumentParser(description="Test the wheel in a bare environment.")
    parser.add_argument("--site", help="folder with the other packages")
    given, others = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        python = environment(folder, given.site)
        shutil.copytree(ROOT / "tests", folder / "tests")
        # The settings of pytest are in pyproject.toml, which is no part of the package.
        shutil.copy(ROOT / "pyproject.toml", folder)
        files = without_checkout(folder / "tests")
        print(f"{len(files)} files of tests need no checkout", flush=True)
        return subprocess.run(
            [python, "-m", "pytest", "-q", *files, *others], cwd=folder
        ).returncode


if __name__ == "__main__":
    sys.exit(main())
