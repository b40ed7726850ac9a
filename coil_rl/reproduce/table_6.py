"""Tables 6 and 7 of the paper: how a robot drives, from its recordings alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

from omegaconf import OmegaConf
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.envs import SimulatedRobotEnv
from coil_rl.envs.recordings.reading import SIMULATED, Recording, read_recording
from coil_rl.errors import UserError
from coil_rl.report import write_csv
from coil_rl.reproduce.result import NO_RUNS, Result, Runs, called
from coil_rl.reproduce.table_6_measures import measure, smoothness
from coil_rl.reproduce.table_6_page import page
from coil_rl.reproduce.table_6_picture import draw_drives
from coil_rl.robot.drivers import Driver, agent_driver, record
from coil_rl.train.build import build_guides
from coil_rl.train.guide_drives import driver_names
from coil_rl.train.load import read_config


class Table6(Result):
    """Smoothness, laps, crashes and lines of several drivers, each from one or several recordings.

    A recording goes by the `policy` that is noted in it, or else by its file's name. Without recordings the guide and
    the agents of runs drive the simulated robot, and are recorded in a folder beside the page; a drive that is there
    is not driven again.

    Args:
        experiments: whose runs drive if there are no recordings.
        recordings: MCAP files, rosbag2 directories or folders of MCAP files; or, by the name of the driver, lists of
            such. With them nothing is trained and nobody drives.
        labels: of the runs that drive, beside the guide of the first of them.
        repeats: drives of each of them, which differ by the noise of the LiDAR.
        laps: of a drive.
        scan: topic of the LiDAR.
        odometry: topic of the odometry; without it the robot is taken to have obeyed its commands.
        command: topic of what the robot was told, such as what a replay says another policy would have.
        car_length: m, the robot's L.
        max_steering: degrees of an action of 1.
        resamples: of the bootstrap.
        seed: of the bootstrap, and of the LiDAR.

    Raises:
        UserError: if there are neither recordings nor experiments.
        RecordingError: for a recording that cannot be used.
    """

    def __init__(
        self,
        experiments: Sequence[str] = (),
        recordings: Sequence[str] | Mapping[str, Sequence[str]] = (),
        *,
        labels: Sequence[str] = ("oil", "ppo", "coil"),
        repeats: int = 3,
        laps: int = 3,
        scan: str = "/scan",
        odometry: str | None = "/odom",
        command: str | None = "/cmd_vel",
        car_length: float = 2 / 7,
        max_steering: float = 80.0,
        resamples: int = 2000,
        seed: int = 0,
    ) -> None:
        counts = {"repeats": repeats, "laps": laps, "resamples": resamples}
        if wrong := [f"{name}={count}" for name, count in counts.items() if count < 1]:
            raise ValueError(f"{wrong[0]} must be at least 1")
        if not labels:
            raise ValueError("labels=[] leaves the guide alone; give at least one")
        named = recordings if isinstance(recordings, Mapping) else {"": recordings}
        files = [(name, path) for name, paths in named.items() for path in _files(paths)]
        given = [(name, read_recording(path, scan, odometry, command)) for name, path in files]
        if recordings and not given:
            raise UserError(f"recordings={recordings} holds no MCAP file; give some, or none, so that runs drive")
        if not given and not experiments:
            raise UserError("recordings=[] and experiments=[] leave nobody to drive; give one of them")
        self.experiments = [] if given else list(experiments)
        self.labels, self.repeats, self.laps, self.seed, self.resamples = list(labels), repeats, laps, seed, resamples
        self.car_length, self.max_steering = car_length, max_steering
        self._measure(given)

    def _measure(self, named: Sequence[tuple[str, Recording]]) -> None:
        self.recordings = [recording for _, recording in named]
        self.drives = [
            measure(name or recording.notes.get(SIMULATED, {}).get("policy", recording.path.stem), recording)
            for name, recording in named
        ]

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make it: see `Result`."""
        if self.experiments:
            own = {experiment: runs[experiment] for experiment in self.experiments}
            self._measure([("", recording) for recording in self._driven(own, stem.with_name(f"{stem.name}_drives"))])
        values = smoothness(self.recordings, self.car_length, self.max_steering)
        rows = [{**drive.row, "smoothness": value} for drive, value in zip(self.drives, values, strict=True)]
        write_csv(rows, stem.with_suffix(".csv"))
        where = " (simulated)" if any(recording.simulated for recording in self.recordings) else ""
        draw_drives(self.drives, stem.with_suffix(".png"), f"The driven lines{where}")
        return page(rows, where, self.max_steering, self.resamples, self.seed)

    def _driven(self, runs: Runs, folder: Path) -> list[Recording]:
        robot = f"{self.car_length:g} m, {self.max_steering:g} degrees"
        about = {"robots": f"{self.repeats} of {robot}, {self.laps} laps, seed {self.seed}"}
        return record(self._drivers(runs), folder, self.repeats, about)

    def _drivers(self, runs: Runs) -> Iterator[Driver]:
        """The guide of the first run, and the agent of each."""
        robots = partial(
            SimulatedRobotEnv, num_cars=self.repeats, assignment="cyclic", laps=self.laps, car_length=self.car_length,
            max_steering=self.max_steering, seed=self.seed,
        )  # fmt: skip
        chosen = [run for of_label in called(self.labels, runs).values() for run in of_label]
        first = read_config(chosen[0].folder, "run", {"device": "cpu"})
        guides = build_guides(first)
        for driver, (name, guide) in zip(driver_names(guides), guides.items(), strict=True):
            about = {"policy": driver, "guide": json.dumps(OmegaConf.to_container(first.guide[name], resolve=True))}
            yield Driver(driver.replace(" ", "_"), about, partial(_seated, robots, guide))
        for run in chosen:
            yield agent_driver(run.folder, read_config(run.folder, "run", {"device": "cpu"}), robots)


def _seated(robots: Callable[[], EnvBase], guide: TensorDictModuleBase) -> tuple[EnvBase, TensorDictModuleBase]:
    return robots(), guide


def _files(paths: Sequence[str]) -> list[Path]:
    found: list[Path] = []
    for path in map(Path, paths):
        inside = path.is_dir() and not (path / "metadata.yaml").exists()
        found += sorted(path.glob("*.mcap")) if inside else [path]
    return found
