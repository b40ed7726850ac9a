"""Which versions of what a run used."""

from __future__ import annotations

import platform
import subprocess
from importlib import metadata
from pathlib import Path

import torch

PACKAGES = (
    "coil-rl", "torch", "torchrl", "tensordict", "hydra-core", "gymnasium", "stable-baselines3", "numpy", "scipy",
    "matplotlib",
)  # fmt: skip


def versions() -> dict[str, str]:
    """Name to version of the packages that matter, of Python and the machine; the commit in a git checkout."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    found["commit"] = _commit()
    found["cpu threads"] = str(torch.get_num_threads())
    found["cuda"] = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "not available"
    return found


def _commit() -> str:
    folder = Path(__file__).resolve().parent
    try:
        git = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=12"]
        return subprocess.run(git, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "not a git checkout"
