"""Guides and trained agents drive the simulated robot, and every drive is recorded; one that is there is kept."""

from __future__ import annotations

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
    """Somebody who can drive robots.

    Attributes:
        name: that its recordings begin with.
        about: what is noted in them: whose drive it is, as `policy`, and all that tells it from another's.
        seated: makes the robots with what the policy needs around them, and the policy.

    Example:
        >>> import tempfile
        >>> from coil_rl.envs import SimulatedRobotEnv
        >>> from coil_rl.guides import SplineGuide
        >>> guide = Driver("guide", {"policy": "guide"}, lambda: (SimulatedRobotEnv(time_limit=1.0), SplineGuide()))
        >>> (recording,) = record([guide], Path(tempfile.mkdtemp()), robots=1)
        >>> recording.path.name, recording.notes["simulated"]["policy"]
        ('guide_0.mcap', 'guide')
    """

    name: str
    about: Mapping[str, str]
    seated: Callable[[], tuple[EnvBase, TensorDictModuleBase]]


def agent_of(
    run: Path, config: DictConfig, robots: Callable[[], EnvBase], which: str = "last", name: str | None = None
) -> Driver:
    """The agent of a run, with its own guides and transforms around the robots.

    Args:
        run: its folder.
        config: of the run.
        robots: makes them, without transforms.
        which: as in `coil_rl.train.load.policy`.
        name: of the driver; by default that of the folder.
    """
    about = {"policy": str(config.label), "seed": str(config.seed), "run": run.name}
    if (kept := weights_file(run, which)).is_file():  # if not, it is refused once it is to drive
        about["policy_sha256"] = hashlib.sha256(kept.read_bytes()).hexdigest()
    return Driver(name or run.name, about, lambda: load_policy_in_env(run, config, robots(), which))


def record(
    drivers: Iterable[Driver], folder: Path, robots: int, about: Mapping[str, str] | None = None
) -> list[Recording]:
    """Let every driver drive, unless recordings in the folder say that it already has.

    Args:
        drivers: each drives for an episode, deterministically.
        folder: gets `NAME_0.mcap`, `NAME_1.mcap` and so on.
        robots: that each drives at the same time.
        about: what else is noted in all recordings, such as what makes these robots other than others.

    Returns:
        The recordings of each driver, in the order of the drivers.

    Raises:
        UserError: for a driver that cannot drive there.
    """
    found: list[Recording] = []
    with tqdm(desc="drive", unit="step", leave=False, mininterval=0.5) as bar:
        for driver in drivers:
            paths = [folder / f"{driver.name}_{robot}.mcap" for robot in range(robots)]
            notes = {**driver.about, **(about or {})}
            bar.set_postfix_str(driver.name)
            known = _known(paths, notes)
            if known is None:
                record_drives(*driver.seated(), paths, notes, bar.update)
                known = [read_recording(path) for path in paths]
            found += known
    return found


def _known(paths: Sequence[Path], notes: Mapping[str, str]) -> list[Recording] | None:
    """The recordings, if all are there, whole, and of just this drive."""
    try:
        found = [read_recording(path, strict=True) for path in paths]
    except RecordingError:
        return None
    fit = (notes.items() <= recording.notes.get(SIMULATED, {}).items() for recording in found)
    return found if all(fit) else None
