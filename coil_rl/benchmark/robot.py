"""How fast scans of a LiDAR become cones: from an MCAP file, many at once, and one at a time as on a robot."""

from __future__ import annotations

import itertools
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from coil_rl.benchmark.turns import Turns
from coil_rl.envs import Perception, read_recording, save_drive, simulated_cone_classifier, simulated_drive


def measure_robot(config: DictConfig, turns: Turns) -> list[dict[str, Any]]:
    """One row a subject: scans per second of a core's time, of a simulated lap with 360 points a scan."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lap.mcap"
        save_drive(simulated_drive("both", config.seed), path)
        recording = read_recording(path)
        ranges, angles = recording.ranges, recording.angles(0)
        perceive = Perception(simulated_cone_classifier())
        scan = itertools.cycle(range(len(ranges)))

        def one() -> int:
            at = next(scan)
            perceive(ranges[at : at + 1], angles)
            return 1

        def all_at_once() -> int:
            perceive(ranges, angles)
            return len(ranges)

        def read() -> int:
            return len(read_recording(path).ranges)

        subjects: dict[str, Callable[[], int]] = {
            "reading MCAP": read, "perception, a recording at once": all_at_once, "perception, one scan at a time": one,
        }  # fmt: skip
        # What is promised is absolute, so other processes must not count.
        rates = replace(turns, clock=time.process_time).rates(subjects)
    return [
        {"what": what, "scans_per_s": statistics.median(rounds), "rounds": rounds} for what, rounds in rates.items()
    ]
