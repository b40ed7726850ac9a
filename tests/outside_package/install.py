"""Installation of the package for tests, offline and in folders of their own."""

import shutil
import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).parent
# The smallest run in its envs.
TINY = [
    "budget.frames=192",
    "budget.num_envs=2",
    "budget.steps=16",
    "checkpoint_every=1",
    "learner.epochs=1",
    "learner.minibatches=2",
    "evaluation.cases=2",
    "evaluation.curve.num_envs=2",
    "evaluation.curve.points=2",
    "evaluation.repeats=1",
    "logger=none",
]
PROXY = [
    "proxy.budget.frames=192",
    "proxy.budget.num_envs=2",
    "proxy.budget.steps=96",
    "proxy.learner.regressor.epochs=1",
]


def install(folder: Path) -> Path:
    """Copy the package into a folder, and return where it is installed.

    Setuptools writes into the folder of the sources.
    """
    shutil.copytree(SOURCE, folder / "source", ignore=shutil.ignore_patterns("__pycache__"))
    offline = [
        "--quiet",
        "--no-index",
        "--no-deps",
        "--no-build-isolation",
        "--target",
        folder / "site",
    ]
    subprocess.run(
        [sys.executable, "-m", "pip", "install", *offline, folder / "source"], check=True
    )
    return folder / "site"
