"""Tables 6 and 7 of the paper: drives of a robot, measured from recordings."""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf
from tqdm import tqdm

from coil_rl.config.build import assemble, build_guides
from coil_rl.config.saved import read_config
from coil_rl.envs import SimulatedRobotEnv
from coil_rl.envs.limits import check_range
from coil_rl.envs.recordings.reading import Recording, read_recording
from coil_rl.envs.robot.course import robot_tracks, track_notes
from coil_rl.envs.track import Track
from coil_rl.errors import UserError
from coil_rl.report import markdown_table, write_csv
from coil_rl.report.runs import Run, read_runs
from coil_rl.report.statistics import count_of_seeds, estimate
from coil_rl.reproduce import pages
from coil_rl.reproduce.recorded_drives import Row, draw_drives, means, measure, record, smoothness
from coil_rl.reproduce.result import NO_RUNS, PAGES, Result, Runs, runs_by_label
from coil_rl.run.folder import weights_file
from coil_rl.run.judge import guide_titles

PAGE = PAGES["table_6"]
PAPER_ROBOT = PAGE["paper"]


@dataclass(eq=False)
class Table6(Result):
    """Smoothness, laps, crashes and lines of several drivers, from recordings.

    A driver's name is the `policy` in its recording's notes, or else the file name. Without
    recordings, the guide of the first run and the agents of all runs drive the simulated robot and
    are recorded next to the page; existing recordings are reused. No recordings, runs or
    experiments at all are a `UserError`, an unusable recording is a `RecordingError`.
    """

    experiments: Sequence[
        str
    ] = ()  # experiments whose agents drive if there are no recordings and runs
    # MCAP files, rosbag2 directories or folders of MCAP files; or lists of them by driver name.
    recordings: Sequence[str] | Mapping[str, Sequence[str]] = ()
    _: KW_ONLY
    runs: Sequence[str] = ()  # folders of runs whose agents drive if there are no recordings
    worlds: Mapping[str, Sequence[Track]] = field(
        default_factory=dict
    )  # further tracks to drive on, by what differs
    labels: Sequence[str] = ("oil", "ppo", "coil")  # of the runs of the experiments that drive
    repeats: int = 3  # drives of each driver, which differ by the LiDAR noise
    laps: int = 3  # laps of a drive
    scan: str = "/scan"  # topic of the LiDAR
    odometry: str | None = "/odom"  # topic of the odometry; None to integrate the commands instead
    command: str | None = (
        "/cmd_vel"  # topic of the robot's commands, or of another policy's, such as a replay's
    )
    car_length: float = 2 / 7  # L of the robot, m
    max_steering: float = 80.0  # degrees of an action of 1
    seed: int = 0  # of the LiDAR

    def __post_init__(self) -> None:
        check_range(1, repeats=self.repeats, laps=self.laps)
        if not self.labels:
            raise ValueError("labels=[] leaves the guide alone; give at least one")
        by_name = self.recordings if isinstance(self.recordings, Mapping) else {"": self.recordings}
        files = [
            (name, file)
            for name, paths in by_name.items()
            for path in paths
            for file in _files(Path(path))
        ]
        self.read = [
            read_recording(file, self.scan, self.odometry, self.command) for _, file in files
        ]
        # Measured here, so that a bad recording fails before any training.
        self.drives = [
            measure(found, name) for (name, _), found in zip(files, self.read, strict=True)
        ]
        if self.recordings and not files:
            raise UserError(
                f"recordings={self.recordings} has no MCAP file; give some, or none to let the runs drive"
            )
        if not files and not self.runs and not self.experiments:
            raise UserError(
                "recordings=[], runs=[] and experiments=[] give no driver; give one of them"
            )
        self.own = read_runs(list(map(Path, self.runs))) if self.runs and not files else []
        self.experiments = [] if files or self.own else list(self.experiments)

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        if self.experiments or self.own:
            trained = {experiment: runs[experiment] for experiment in self.experiments}
            selected = self.own or [
                run for group in runs_by_label(self.labels, trained).values() for run in group
            ]
            self.read = self._record(selected, stem.with_name(f"{stem.name}_drives"))
            self.drives = [measure(recording) for recording in self.read]
        rows = [
            {**drive.row, "smoothness": smoothness(recording, self.car_length, self.max_steering)}
            for drive, recording in zip(self.drives, self.read, strict=True)
        ]
        write_csv(rows, stem.with_suffix(".csv"))
        suffix = " (simulated)" if any(recording.simulated for recording in self.read) else ""
        draw_drives(self.drives, stem.with_suffix(".png"), f"The driven lines{suffix}")
        return robot_page(rows, suffix, self.max_steering)

    def _record(self, runs: Sequence[Run], folder: Path) -> list[Recording]:
        robot = f"{self.car_length:g} m, {self.max_steering:g} degrees"
        robots = f"{self.repeats} of {robot}, {self.laps} laps, seed {self.seed}"
        recordings: list[Recording] = []
        with tqdm(desc="drive", unit="step", leave=False, mininterval=0.5) as bar:
            for world, tracks in {"": robot_tracks(), **self.worlds}.items():
                cones = hashlib.sha256(
                    json.dumps([track_notes(track) for track in tracks]).encode()
                ).hexdigest()
                where = {"robots": robots, "world": world, "cones_sha256": cones}
                for name, notes, make_env_and_policy in self._drivers(runs, tracks):
                    bar.set_postfix_str(name)
                    paths = [
                        folder / f"{'_'.join([name, str(n), *world.split()])}.mcap"
                        for n in range(self.repeats)
                    ]
                    recordings += record(make_env_and_policy, paths, {**notes, **where}, bar.update)
        return recordings

    def _drivers(
        self, runs: Sequence[Run], tracks: Sequence[Track]
    ) -> Iterator[tuple[str, dict[str, str], Any]]:
        """Yield name, notes and the maker of env and policy for the guide of the first run and for each agent."""
        make_env = partial(
            SimulatedRobotEnv,
            tracks,
            num_envs=self.repeats,
            assignment="cyclic",
            laps=self.laps,
            car_length=self.car_length,
            max_steering=self.max_steering,
            seed=self.seed,
        )
        configs = [read_config(run.folder, "run", {"device": "cpu"}) for run in runs]
        guides = build_guides(configs[0])
        for display_name, (name, guide) in zip(guide_titles(guides), guides.items(), strict=True):
            config = json.dumps(OmegaConf.to_container(configs[0].guide[name], resolve=True))
            about = {"policy": display_name, "guide": config}
            yield (
                display_name.replace(" ", "_"),
                about,
                partial(lambda policy: (make_env(), policy), guide),
            )
        for run, own in zip(runs, configs, strict=True):
            about = {"policy": str(own.label), "seed": str(own.seed), "run": run.folder.name}
            if (
                weights := weights_file(run.folder)
            ).is_file():  # a missing file is reported when the policy is loaded
                about["policy_sha256"] = hashlib.sha256(weights.read_bytes()).hexdigest()
            make = partial(
                lambda folder, own: assemble(own, folder).in_env(make_env()), run.folder, own
            )
            yield run.folder.name, about, make


def robot_page(rows: Sequence[Row], suffix: str, max_steering: float) -> str:
    """Return the page of Tables 6 and 7, given the measures of the drives and a suffix of the headings."""
    by_world: dict[str, dict[str, dict[str | None, list[Row]]]] = {}
    for row in rows:
        by_world.setdefault(row["world"], {}).setdefault(row["method"], {}).setdefault(
            row["seed"], []
        ).append(row)
    parts = [f"## Table 6: the robot{suffix}"]
    claims: list[Row] = []
    for world, by_method in by_world.items():
        table = []
        for method, by_seed in by_method.items():
            paper = PAPER_ROBOT.get(method, dict.fromkeys(PAPER_ROBOT["guide"]))
            line = means([row for drives in by_seed.values() for row in drives])
            line |= {"method": method, "seeds": None if None in by_seed else len(by_seed)}
            table.append(line | {f"paper {key}": value for key, value in paper.items()})
        parts += [*pages.world_heading(world), markdown_table(table, PAGE["columns"])]
        parts += [
            f"### Table 7, measured{suffix}",
            markdown_table(table, PAGE["columns_of_table_7"]),
        ]
        claims += [{"world": world, **row} for row in _claims(table, by_method)]
    notes = PAGE["notes"].format(max_steering=max_steering)
    if not claims:
        return "\n\n".join([*parts, notes])
    section = pages.claims_section(
        claims, {"paper": "paper", "seeds": "seeds", "ours": "ours (95 %)"}
    )
    return "\n\n".join([*parts, f"{notes}\n{PAGE['claim_notes']}", section])


def _claims(
    table: Sequence[Row], drives: Mapping[str, Mapping[str | None, Sequence[Row]]]
) -> Sequence[Row]:
    """Return the verdicts on the claims of the paper in one world."""
    of_seeds = {method: {s: means(rows) for s, rows in of.items()} for method, of in drives.items()}
    claims = [row for claim, *about in PAGE["claims"] if (row := _claim(of_seeds, claim, *about))]
    crashes = [
        line for line in table if line["method"] in PAPER_ROBOT and line["crashes"] is not None
    ]
    if not claims or not crashes:
        return claims
    details = ", ".join(
        f"{line['method']} {_crashes(line, of_seeds[line['method']])}" for line in crashes
    )
    ours = pages.certain_verdict(not any(line["crashes"] for line in crashes), details)
    return [*claims, {"claim": "Nobody crashes", "paper": "0", "ours": ours}]


def _claim(
    by_method: Mapping[str, Mapping[str | None, Row]],
    claim: str,
    key: str,
    driver: str,
    other: str,
    sign: int,
) -> dict[str, Any] | None:
    """Return the verdict on a claim; None if a driver is missing, or they have no seed in common."""
    if driver not in by_method or other not in by_method:
        return None
    # A driver without seeds, such as the guide, is compared with every seed.
    without_seed = by_method[other].get(None)
    pairs = [
        (row, by_method[other].get(number, without_seed))
        for number, row in by_method[driver].items()
    ]
    both = [(row, reference) for row, reference in pairs if reference is not None]
    if not both:
        return None
    # A drive without a complete lap has not steered through every turn.
    complete = [pair for pair in both if key == "clearance" or all(row["laps"] for row in pair)]
    differences = np.array([row[key] - reference[key] for row, reference in complete])
    differences = differences[np.isfinite(differences)]
    spec = "+.2f" if key == "lap_time" else "+.3f"
    line: dict[str, Any] = {
        "claim": claim,
        "seeds": f"{len(differences)} of {len(both)}",
        "paper": None,
        "ours": None,
    }
    if key in ("smoothness", "lap_time"):
        line["paper"] = f"{PAPER_ROBOT[driver][key] - PAPER_ROBOT[other][key]:{spec}}"
    if len(differences):
        line["ours"] = pages.Claim(estimate(differences), spec, sign)
    return line


def _crashes(line: Row, by_seed: Mapping[str | None, Row]) -> str:
    """Return the number of seeds with a crash; of drives for a driver without seeds."""
    if line["seeds"] is None:
        return f"{line['crashes']} of {line['drives']} drives"
    return (
        f"{count_of_seeds(sum(row['crashes'] > 0 for row in by_seed.values()), len(by_seed))} seeds"
    )


def _files(path: Path) -> list[Path]:
    """Return the MCAP files of a folder; any other path is itself a recording."""
    return (
        sorted(path.glob("*.mcap"))
        if path.is_dir() and not (path / "metadata.yaml").exists()
        else [path]
    )
