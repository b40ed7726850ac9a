import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from itertools import chain
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from try_wheel import NEED_A_CHECKOUT

ROOT = Path(__file__).resolve().parents[1]
UNPINNED = {"trackio"}  # extras that need other versions than the tested ones
PACKAGES = {
    "envs": "coil_rl/envs",
    "transforms": "coil_rl/transforms",
    "conf": "coil_rl/conf",
    "fmu": "coil_fmu",
    "paper": "coil_paper",
    "studies": "coil_studies",
    "robot": "coil_robot",
}
SHIPPED = [f"policies/**/*{end}" for end in (".md", ".csv", ".pt", ".yaml")]


def run(*command: str | Path, cwd: Path, pythonpath: Path | None = None) -> str:
    env = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    if pythonpath:
        env["PYTHONPATH"] = str(pythonpath)
    done = subprocess.run(
        [*map(str, command)], cwd=cwd, env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the sources in which the links are small text files, as on Windows.

    A nested YAML and a track are added to test the globs.
    """
    tree = tmp_path_factory.mktemp("packaging") / "tree"
    ignore = shutil.ignore_patterns(
        ".*", "build", "dist", "outputs", "*.egg-info", "__pycache__", "site", "node_modules"
    )
    shutil.copytree(ROOT, tree, symlinks=True, ignore=ignore)
    for target, name in PACKAGES.items():
        link = tree / name
        link.unlink(missing_ok=True)
        link.write_text("../" * name.count("/") + target)
    for planted in (
        "conf/a/b/planted.yaml",
        "envs/tracks/a/planted.csv",
        "paper/conf/a/planted.yaml",
    ):
        (tree / planted).parent.mkdir(parents=True, exist_ok=True)
        (tree / planted).write_text("")
    return tree


@pytest.fixture(scope="module")
def wheel(tree: Path) -> Path:
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", "..", cwd=tree)
    [wheel] = tree.parent.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def installed(wheel: Path) -> Path:
    target = wheel.parent / "installed"
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-index", "--no-deps"]
    run(*pip, "--target", target, wheel, cwd=wheel.parent)
    return target


@pytest.mark.slow
def test_wheel_contains_exactly_the_sources_and_their_data(tree: Path, wheel: Path) -> None:
    patterns = dict.fromkeys(("conf", "fmu", "paper", "studies"), ("*.py", "*.yaml"))
    patterns |= {
        "coil_rl": ["*.py", "*.html", "*.j2", "*.json", "py.typed", *SHIPPED],
        "envs": ["*.py", "*.json", "tracks/**/*.csv"],
        "robot": ["*.py", "*.yaml", "*.json"],
        "transforms": ["*.py"],
    }
    expected = set()
    for folder, globs in patterns.items():
        package = PACKAGES.get(folder, folder)
        for path in chain.from_iterable((tree / folder).rglob(glob) for glob in globs):
            expected.add(f"{package}/{path.relative_to(tree / folder).as_posix()}")
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert names == expected
    assert {"coil_rl/py.typed", "coil_rl/conf/a/b/planted.yaml"} <= names


@pytest.mark.slow
def test_sdist_contains_everything_that_its_tests_need(tree: Path) -> None:
    run(sys.executable, "-m", "build", "--sdist", "--no-isolation", "--outdir", "..", cwd=tree)
    [sdist] = tree.parent.glob("*.tar.gz")
    with tarfile.open(sdist) as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    folders = ("benchmarks", "coil_rl", "docs", "examples", "tests", *PACKAGES)
    paths = chain.from_iterable((tree / folder).rglob("*") for folder in folders)
    needed = {path.relative_to(tree).as_posix() for path in paths if path.is_file()}
    needed |= {"CONTRIBUTING.md", "LICENSE", "Makefile", "README.md"}
    needed |= {"constraints.txt", "pyproject.toml"}
    assert needed - names - {*PACKAGES.values()} == set()


@pytest.mark.slow
def test_installed_wheel_runs_from_another_folder(installed: Path, tmp_path: Path) -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    for target in scripts.values():
        module = target.removesuffix(":main")
        assert (installed / module.replace(".", "/")).with_suffix(".py").is_file()
    program = """
import importlib.resources
import coil_paper, coil_rl, coil_rl.conf, coil_rl.envs, coil_rl.transforms
for module in (coil_paper, coil_rl, coil_rl.conf, coil_rl.envs, coil_rl.transforms):
    print(module.__file__)
print(importlib.resources.files("coil_rl.conf").joinpath("a", "b", "planted.yaml"))
from coil_rl.programs.train import main
main()
"""
    tiny = ["method=guide", "guide=zero", "env.laps=1", "evaluation.gif=false", "hydra.run.dir=run"]
    out = run(sys.executable, "-c", program, *tiny, cwd=tmp_path, pythonpath=installed)
    lines = out.splitlines()[:6]
    outside = [
        line for line in lines if not Path(line).resolve().is_relative_to(installed.resolve())
    ]
    assert (len(lines), outside) == (6, [])
    assert all(Path(line).is_file() for line in lines)
    assert "test_3" in out, "the shipped tracks are missing in the wheel"
    paper = [sys.executable, "-m", "coil_paper.program", "table=1", "budget=smoke"]
    assert "table_1 made" in run(*paper, cwd=tmp_path, pythonpath=installed)


def test_what_try_wheel_leaves_out_is_there() -> None:
    assert [name for name in NEED_A_CHECKOUT if not (ROOT / "tests" / name).exists()] == []


def test_every_dependency_is_pinned_within_its_range() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = dict(line.split("==") for line in lines if not line.startswith("#"))
    pins = {canonicalize_name(name): version for name, version in pins.items()}
    groups = project["optional-dependencies"].items()
    extras = [text for name, extra in groups if name not in UNPINNED for text in extra]
    requirements = [Requirement(text) for text in [*project["dependencies"], *extras]]
    wrong = []
    for requirement in requirements:
        pin = pins.get(canonicalize_name(requirement.name), "0")
        if requirement.name != project["name"] and not requirement.specifier.contains(pin):
            wrong.append(str(requirement))
    assert not wrong, "constraints.txt has no version, or one out of range, for these"
