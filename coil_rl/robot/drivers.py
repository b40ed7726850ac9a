"""Recorded drives of guides and trained agents on the simulated robot; existing recordings are reused."""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from tqdm import tqdm

from coil_rl.envs import RecordingError, read_recording, record_drives
from coil_rl.envs.recordings.reading import SIMULATED, Recording
from coil_rl.train.load import load_policy_in_env, weights_file


@dataclass(frozen=True)
class Driver:
    """A guide or an agent that can drive robots."""

    name: str  # first part of the names of its recordings
    about: Mapping[str, str]  # notes in its recordings: its display name as `policy`, and what tells it from others
    # Returns the robots, with the transforms of the policy, and the policy.
    make_env_and_policy: Callable[[], tuple[EnvBase, TensorDictModuleBase]]


def agent_driver(
    run: Path, config: DictConfig, make_robots: Callable[[], EnvBase], which: str = "last", name: str | None = None
) -> Driver:
    """Return the last or best agent of a run as a driver, with its own guides and transforms.

    `make_robots` returns the robots without transforms. The name is that of the run's folder by default.
    """
    about = {"policy": str(config.label), "seed": str(config.seed), "run": run.name}
    if (weights := weights_file(run, which)).is_file():  # a missing file is reported when the policy is loaded
        about["policy_sha256"] = hashlib.sha256(weights.read_bytes()).hexdigest()
    return Driver(name or run.name, about, lambda: load_policy_in_env(run, config, make_robots(), which))


def record(
    drivers: Iterable[Driver], folder: Path, robots: int, about: Mapping[str, str] | None = None
) -> list[Recording]:
    """Return recordings of a deterministic episode of each driver; existing ones with equal notes are reused.

    The files are `NAME_0.mcap`, `NAME_1.mcap` and so on, one for each of the `robots` of a driver. `about` has further
    notes for all recordings, such as the settings of the robots.

    Raises:
        UserError: for a driver that cannot drive the robots.
    """
    recordings: list[Recording] = []
    with tqdm(desc="drive", unit="step", leave=False, mininterval=0.5) as bar:
        for driver in drivers:
            paths = [folder / f"{driver.name}_{robot}.mcap" for robot in range(robots)]
            notes = {**driver.about, **(about or {})}
            bar.set_postfix_str(driver.name)
            existing = _existing_recordings(paths, notes)
            if existing is None:
                record_drives(*driver.make_env_and_policy(), paths, notes, bar.update)
                existing = [read_recording(path) for path in paths]
            recordings += existing
    return recordings


def _existing_recordings(paths: Sequence[Path], notes: Mapping[str, str]) -> list[Recording] | None:
    """Return the recordings if all exist, are complete, and have these notes."""
    try:
        recordings = [read_recording(path, strict=True) for path in paths]
    except RecordingError:
        return None
    equal = (notes.items() <= recording.notes.get(SIMULATED, {}).items() for recording in recordings)
    return recordings if all(equal) else None
