"""Tables 6 and 7 of the paper: drives of a robot, measured from recordings."""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tqdm import tqdm

from coil_paper.reproduce import pages
from coil_paper.reproduce.recorded_drives import (
    Row,
    draw_drives,
    means,
    measure,
    record,
    smoothness,
)
from coil_paper.reproduce.result import NO_RUNS, PAGES, Result, Runs, runs_by_label
from coil_rl import SimulatedRobotEnv, UserError, guide_titles, open_run
from coil_rl.envs import Recording, Track, read_recording, robot_tracks
from coil_rl.envs.robot import track_notes
from coil_rl.ranges import Count, Len, checked
from coil_rl.report import Run, count_of_seeds, estimate, markdown_table, read_runs, write_csv

PAGE = PAGES["table_6"]
PAPER_ROBOT = PAGE["paper"]


@checked
@dataclass(eq=False)
class Table6(Result):
    """Smoothness, laps, crashes and lines of several policies, from recordings.

    A policy's name is the `policy` in its recording's notes, or else the file name. Without
    recordings, the guide of the first run and the agents of all runs drive the simulated robot and
    are recorded next to the page; existing recordings are reused.

    Args:
        experiments: names of the experiments whose agents drive if there are no recordings and no
            runs, files of `paper/conf/experiment`.
        recordings: MCAP files, rosbag2 directories or folders of MCAP files; or lists of them by
            name of the policy.
        runs: folders of runs whose agents drive if there are no recordings.
        worlds: further tracks to drive on, by what differs.
        labels: of the runs of the experiments that drive.
        repeats: number of drives of each policy, which differ by the LiDAR noise.
        laps: number of laps of a drive.
        scan: topic of the LiDAR.
        odometry: topic of the odometry; None to integrate the commands instead.
        command: topic of the robot's commands, or of another policy's, such as a replay's.
        car_length: length L of the robot, m.
        max_steering: angle of an action of 1, degrees.
        seed: of the LiDAR.

    Raises:
        UserError: if there are no recordings, runs and experiments at all.
        RecordingError: if a recording cannot be used.
    """

    experiments: Sequence[str] = ()
    recordings: Sequence[str] | Mapping[str, Sequence[str]] = ()
    _: KW_ONLY
    runs: Sequence[str] = ()
    worlds: Mapping[str, Sequence[Track]] = field(default_factory=dict)
    labels: Annotated[Sequence[str], Len(1)] = ("oil", "ppo", "coil")
    repeats: Count = 3
    laps: Count = 3
    scan: str = "/scan"
    odometry: str | None = "/odom"
    command: str | None = "/cmd_vel"
    car_length: float = 2 / 7
    max_steering: float = 80.0
    seed: int = 0

    def __post_init__(self) -> None:
        files = self._named_files()
        self.read = [
            read_recording(file, self.scan, self.odometry, self.command) for _, file in files
        ]
        # Measured here, so that a bad recording fails before any training.
        self.drives = [
            measure(found, name) for (name, _), found in zip(files, self.read, strict=True)
        ]
        if self.recordings and not files:
            raise UserError(
                f"recordings={self.recordings} has no MCAP file; "
                "give some, or none to let the runs drive"
            )
        if not files and not self.runs and not self.experiments:
            raise UserError(
                "recordings=[], runs=[] and experiments=[] give no driver; give one of them"
            )
        self.own = read_runs(list(map(Path, self.runs))) if self.runs and not files else []
        self.experiments = [] if files or self.own else list(self.experiments)

    def _named_files(self) -> list[tuple[str, Path]]:
        """Return all recordings, each with the given name of its policy, "" if none is given."""
        by_name = self.recordings if isinstance(self.recordings, Mapping) else {"": self.recordings}
        files = []
        for name, paths in by_name.items():
            files += [(name, file) for path in paths for file in _files(Path(path))]
        return files

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        if self.experiments or self.own:
            trained = {experiment: runs[experiment] for experiment in self.experiments}
            found = {} if self.own else runs_by_label(self.labels, trained)
            driving = self.own or list(chain.from_iterable(found.values()))
            self.read = self._record(driving, stem.with_name(f"{stem.name}_drives"))
            self.drives = [measure(recording) for recording in self.read]
        rows = [
            {**drive.row, "smoothness": smoothness(own, self.car_length, self.max_steering)}
            for drive, own in zip(self.drives, self.read, strict=True)
        ]
        write_csv(rows, stem.with_suffix(".csv"))
        suffix = " (simulated)" if any(recording.simulated for recording in self.read) else ""
        draw_drives(self.drives, stem.with_suffix(".png"), f"The driven lines{suffix}")
        return robot_page(rows, suffix, self.max_steering)

    def _record(self, runs: Sequence[Run], folder: Path) -> list[Recording]:
        """Record the drives of the guide and of all agents in all worlds."""
        robot = f"{self.car_length:g} m, {self.max_steering:g} degrees"
        robots = f"{self.repeats} of {robot}, {self.laps} laps, seed {self.seed}"
        recordings: list[Recording] = []
        with tqdm(desc="drive", unit="step", leave=False, mininterval=0.5) as bar:
            for world, tracks in {"": robot_tracks(), **self.worlds}.items():
                cones = json.dumps([track_notes(track) for track in tracks])
                cones_sha256 = hashlib.sha256(cones.encode()).hexdigest()
                where = {"robots": robots, "world": world, "cones_sha256": cones_sha256}
                for name, notes, make_env_and_policy in self._drivers(runs, tracks):
                    bar.set_postfix_str(name)
                    names = ["_".join([name, str(n), *world.split()]) for n in range(self.repeats)]
                    paths = [folder / f"{each}.mcap" for each in names]
                    recordings += record(make_env_and_policy, paths, {**notes, **where}, bar.update)
        return recordings

    def _drivers(
        self, runs: Sequence[Run], tracks: Sequence[Track]
    ) -> Iterator[tuple[str, dict[str, str], Any]]:
        """Yield what drives: the guide of the first run, then each agent.

        Yields:
            The name for files, the notes for recordings, and a function that makes the env and the
            policy.
        """
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
        opened = [open_run(run.folder) for run in runs]
        guides = opened[0].make_env.guides()
        for display_name, (name, guide) in zip(guide_titles(guides), guides.items(), strict=True):
            settings = json.dumps(opened[0].settings["guide"][name])
            about = {"policy": display_name, "guide": settings}
            make = partial(lambda policy: (make_env(), policy), guide)
            yield display_name.replace(" ", "_"), about, make
        for run in opened:
            about = {"policy": run.label, "seed": str(run.seed), "run": run.folder.name}
            weights = run.folder / "policy_last.pt"
            if weights.is_file():  # a missing file is reported when the policy is loaded
                about["policy_sha256"] = hashlib.sha256(weights.read_bytes()).hexdigest()
            make = partial(lambda agent: agent.in_env(make_env()), run)
            yield run.folder.name, about, make


def robot_page(rows: Sequence[Row], suffix: str, max_steering: float) -> str:
    """Return the page of Tables 6 and 7.

    Args:
        suffix: of the headings, such as " (simulated)".
        max_steering: angle of an action of 1, degrees.
    """
    by_world: dict[str, dict[str, dict[str | None, list[Row]]]] = {}
    for row in rows:
        by_method = by_world.setdefault(row["world"], {})
        by_method.setdefault(row["method"], {}).setdefault(row["seed"], []).append(row)
    parts = [f"## Table 6: the robot{suffix}"]
    claims: list[Row] = []
    for world, by_method in by_world.items():
        table = [_line(method, by_seed) for method, by_seed in by_method.items()]
        parts += [*pages.world_heading(world), markdown_table(table, PAGE["columns"])]
        parts.append(f"### Table 7, measured{suffix}")
        parts.append(markdown_table(table, PAGE["columns_of_table_7"]))
        claims += [{"world": world, **row} for row in _claims(table, by_method)]
    notes = PAGE["notes"].format(max_steering=max_steering)
    if not claims:
        return "\n\n".join([*parts, notes])
    section = pages.claims_section(
        claims, {"paper": "paper", "seeds": "seeds", "ours": "ours (95 %)"}
    )
    return "\n\n".join([*parts, f"{notes}\n{PAGE['claim_notes']}", section])


def _line(method: str, by_seed: Mapping[str | None, Sequence[Row]]) -> Row:
    """Return the line of the table of one policy, with the paper's numbers where it has some."""
    line = means(list(chain.from_iterable(by_seed.values())))
    line |= {"method": method, "seeds": None if None in by_seed else len(by_seed)}
    paper = PAPER_ROBOT.get(method, dict.fromkeys(PAPER_ROBOT["guide"]))
    return line | {f"paper {key}": value for key, value in paper.items()}


def _claims(
    table: Sequence[Row], drives: Mapping[str, Mapping[str | None, Sequence[Row]]]
) -> list[Row]:
    """Return the verdicts on the claims of the paper in one world.

    Args:
        drives: the measures of the drives by policy and by seed.
    """
    of_seeds = {
        method: {seed: means(rows) for seed, rows in by_seed.items()}
        for method, by_seed in drives.items()
    }
    found = [_claim(of_seeds, claim, *about) for claim, *about in PAGE["claims"]]
    claims: list[Row] = [row for row in found if row is not None]
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
    policy: str,
    other: str,
    sign: int,
) -> dict[str, Any] | None:
    """Return the verdict on the claim that a policy has more of a measure than another one.

    Args:
        by_method: measures by policy and by seed.
        policy: the policy that is claimed to have more.
        sign: -1 if it is claimed to have less.

    Returns:
        A row of the table; None if a policy is missing, or they have no seed in common.
    """
    if policy not in by_method or other not in by_method:
        return None
    # A policy without seeds, such as the guide, is compared with every seed.
    theirs, without_seed = by_method[other], by_method[other].get(None)
    pairs = [(row, theirs.get(seed, without_seed)) for seed, row in by_method[policy].items()]
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
        "ours": pages.Claim(estimate(differences), spec, sign),
    }
    if key in ("smoothness", "lap_time"):
        line["paper"] = f"{PAPER_ROBOT[policy][key] - PAPER_ROBOT[other][key]:{spec}}"
    return line


def _crashes(line: Row, by_seed: Mapping[str | None, Row]) -> str:
    """Return the number of seeds with a crash; of drives for a policy without seeds."""
    if line["seeds"] is None:
        return f"{line['crashes']} of {line['drives']} drives"
    crashed = sum(row["crashes"] > 0 for row in by_seed.values())
    return f"{count_of_seeds(crashed, len(by_seed))} seeds"


def _files(path: Path) -> list[Path]:
    """Return the MCAP files of a folder; any other path is itself a recording."""
    is_rosbag = (path / "metadata.yaml").exists()
    return sorted(path.glob("*.mcap")) if path.is_dir() and not is_rosbag else [path]
