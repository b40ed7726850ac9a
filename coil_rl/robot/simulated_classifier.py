"""The cone classifier that comes with the project, which learned from simulated labelling drives and nothing real."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from coil_rl.envs.robot.simulated_drives import labelling_drives
from coil_rl.files import whole_file
from coil_rl.robot.classifier import Training, cone_classifier, train_on_drives

SEEDS = range(5)
DIGITS = 9


def train_on_simulated_drives(seeds: Sequence[int] = SEEDS) -> Training:
    """Train on a simulated drive past left cones and one past right cones for each seed, one fold a seed."""
    drives = [(drive.ranges.numpy(), drive.angles.numpy()) for drive in labelling_drives(seeds)]
    return train_on_drives(drives[::2], drives[1::2])


def write_simulated_cone_classifier(path: str | os.PathLike[str]) -> None:
    """Train the shipped classifier anew and write it where the package keeps it, `envs/robot/simulated_cones.json`."""
    classifier = cone_classifier(train_on_simulated_drives().pipeline)
    numbers = {field.name: _rounded(getattr(classifier, field.name)) for field in fields(classifier)}
    with whole_file(path) as unfinished:
        text = ",\n".join(f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in numbers.items())
        unfinished.write_text(f"{{\n{text}\n}}\n", encoding="utf-8", newline="")


def _rounded(value: object) -> object:
    return np.vectorize(lambda number: float(f"{number:.{DIGITS}g}"))(value).tolist()
