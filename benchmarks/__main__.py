"""Command line of the speed measurements.

The parts are measured and compared with the goals; the results are benchmark.md and benchmark.json.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import time
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from benchmarks.driving import (
    measure_compiled,
    measure_cores,
    measure_driving,
    measure_guide,
    measure_robot,
    profile_operators,
    train_config,
)
from benchmarks.gymnasium_speed import measure_gymnasium
from benchmarks.one_car import measure_one_car
from benchmarks.process import measure_processes
from benchmarks.replay_speed import measure_replay
from benchmarks.slow_plant import measure_workers
from benchmarks.timing import Row
from benchmarks.training import (
    measure_command,
    measure_sb3,
    measure_shares,
    measure_training,
)
from coil_rl.config.check import check
from coil_rl.errors import UserError
from coil_rl.programs.app import program
from coil_rl.report import markdown_table
from coil_rl.run.folder import versions

PARTS: Mapping[str, tuple[str, Callable[[Namespace], list[Row] | str]]] = {
    "processes": ("Start-up and memory of fresh processes", measure_processes),
    "env": (
        "Env steps per second, with resets, random actions unless the guide drives",
        measure_driving,
    ),
    "guide": ("The guide alone, CPU time", measure_guide),
    "cores": ("The guide drives, in one process on each core", measure_cores),
    "training": ("Training in frames per second", measure_training),
    "shares": ("Shares of the time of an update, collection included", measure_shares),
    "robot": ("Recordings and perception of the robot, 360 points a scan, CPU time", measure_robot),
    "one_car": ("Guide drives, beside one car in NumPy and SciPy", measure_one_car),
    "sb3": ("PPO beside Stable-Baselines3", measure_sb3),
    "gymnasium": (
        "PPO on Gymnasium envs beside Stable-Baselines3, equal settings, CPU time",
        measure_gymnasium,
    ),
    "replay": ("Updates of learners with replay, CPU time, beside others", measure_replay),
    "workers": ("A Gymnasium env of 2 ms a step, in one process and one a core", measure_workers),
    "operators": ("Operators of 20 batched steps with advice", profile_operators),
    "command": ("coil-train with its defaults, from the command to its pictures", measure_command),
    "compiled": ("The guide's drives in steps per second, with compiled steps", measure_compiled),
}
# Part of the results, text of the row, key of the number, and the bound that it is to keep.
GOALS = [
    ("training", "PPO / by hand, {batch}", "ppo / by hand", ">=", 0.95),
    ("training", "COIL / by hand, {batch}", "coil / by hand", ">=", 0.95),
    ("training", "PPO compiled / by hand, {batch}", "ppo compiled / by hand", ">=", 1.3),
    ("training", "COIL compiled / by hand, {batch}", "coil compiled / by hand", ">=", 1.3),
    ("command", "default command, {time} time (s)", "whole command (s)", "<", 45),
    (
        "cores",
        "{cars} cars with the guide, {processes} processes (steps/s)",
        "together (steps/s)",
        ">=",
        580_000,
    ),
    ("one_car", "{cars} cars with the guide / one car in NumPy", "ratio", ">=", 500),
    ("sb3", "PPO / Stable-Baselines3 with {envs} envs", "ratio", ">=", 10),
    ("gymnasium", "PPO / Stable-Baselines3, {env}, {envs} envs", "ratio", ">=", 1.05),
    ("replay", "{learner} / Stable-Baselines3, batch {batch}, {hidden}", "ours / sb3", ">=", 1.2),
    (
        "replay",
        "{learner} compiled / Stable-Baselines3, batch {batch}, {hidden}",
        "ours, compiled / sb3",
        ">=",
        4,
    ),
    ("workers", "{subject}, {processes} processes / one, a core", "ratio / cores", ">=", 0.9),
    ("robot", "{subject} (scans/s)", "scans/s", ">=", 1000),
    ("processes", "state per car (B), {cars} cars", "state per car (B)", "<", 2000),
]
SHORT = [
    "budget.frames=4096",
    "budget.num_envs=64",
    "evaluation.repeats=1",
    "evaluation.gif=false",
    "env.laps=1",
]
FULL = {
    "cars": [64, 256, 1024, 4096, 16384, 65536],
    "batches": [(256, 64), (1024, 32), (4096, 16)],
    "compare_cars": 4096,
    "memory_cars": [64, 4096, 65536],
    "sb3_frames": 512,
    "gymnasium_envs": [4, 8, 16],
    "gymnasium_steps": 256,
    "replay_sizes": 3,
    "seconds": 2.0,
    "repeats": 5,
    "compile_updates": True,
    "command": [],
}
QUICK = {
    "cars": [16, 64],
    "batches": [(16, 16)],
    "compare_cars": 64,
    "memory_cars": [64, 1024],
    "sb3_frames": 64,
    "gymnasium_envs": [4],
    "gymnasium_steps": 32,
    "replay_sizes": 1,
    "seconds": 0.1,
    "repeats": 2,
    "compile_updates": False,
    "command": SHORT,
}


def parse(argv: Sequence[str] | None = None) -> Namespace:
    """Return the options, with the sizes of `FULL` or `QUICK`."""
    parser = argparse.ArgumentParser(
        "python -m benchmarks", description="Measure the speed of coil-rl."
    )
    parser.add_argument(
        "overrides", nargs="*", metavar="KEY=VALUE", help="of coil-train, e.g. learner.compile=true"
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    parts = [name for name in PARTS if name != "compiled"]
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    parser.add_argument("--cars", nargs="+", type=int, help="numbers of cars for env steps")
    parser.add_argument(
        "--compile",
        nargs="+",
        type=int,
        default=[],
        metavar="CARS",
        help="also with compiled steps",
    )
    parser.add_argument(
        "--eager",
        dest="compile_updates",
        action="store_const",
        const=False,
        help="training without compiled updates, which take minutes to compile",
    )
    parser.add_argument("--seconds", type=float, help="of each subject, all rounds together")
    parser.add_argument("--repeats", type=int, help="rounds, in each of which every subject works")
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to see that it works")
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("outputs/benchmark") / time.strftime("%Y-%m-%d_%H-%M-%S"),
    )
    args = parser.parse_intermixed_args(argv)
    sizes = QUICK if args.quick else FULL
    for key, value in sizes.items():
        if getattr(args, key, None) is None:
            setattr(args, key, value)
    if args.compile:
        args.parts = [*args.parts, "compiled"]
    if (args.output / "benchmark.json").exists():
        parser.error(
            f"{args.output} already holds a benchmark; choose another folder with --output"
        )
    return args


def check_configuration(args: Namespace) -> None:
    """Raise a `UserError` for the first mistake in the overrides."""
    for override in args.overrides:
        if re.match(r"[+~]*method(@\w*)?=", override):
            raise UserError(
                f"{override} has no effect: the methods ppo and coil are compared; leave it out"
            )
    check(train_config(args, "coil"))


def goals(results: Mapping[str, Any]) -> list[Row]:
    """Return the measured values beside the goals of the project."""
    rows: list[Row] = []
    for part, subject, key, sign, bound in GOALS:
        for row in results.get(part, []):
            if key in row:
                goal: Row = {"subject": subject.format(**row), "value": row[key]}
                goal["goal"] = f"{sign} {bound}"
                goal["met"] = row[key] >= bound if sign == ">=" else row[key] < bound
                rows.append(goal)
    return rows


def page(results: Mapping[str, Any]) -> str:
    """Return the results as Markdown tables."""
    sections = [("Goals", results["goals"])]
    sections += [(title, results.get(part)) for part, (title, _) in PARTS.items()]
    return "\n\n".join(f"## {title}\n\n{_table(rows)}" for title, rows in sections if rows)


def _table(rows: Sequence[Row] | str) -> str:
    if isinstance(rows, str):
        return f"```\n{rows}\n```"
    cells = [{key: _cell(value) for key, value in row.items() if key != "rounds"} for row in rows]
    return markdown_table(cells, {key: (key, "") for row in cells for key in row})


def _cell(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, print the page and write it, with every number as JSON."""
    with program("benchmark"):
        _run(parse(argv))


def _run(args: Namespace) -> None:
    check_configuration(args)
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    # The profiler prints its start and end otherwise.
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")
    args.output.mkdir(parents=True, exist_ok=True)
    settings = {key: value for key, value in vars(args).items() if key != "output"}
    results: dict[str, Any] = {"versions": versions(), "settings": settings, "goals": []}
    for part in tqdm(args.parts, unit="part", desc="benchmark"):
        results[part] = PARTS[part][1](args)
        results["goals"] = goals(results)
        # Written after each part, so that an interrupted run keeps its results.
        (args.output / "benchmark.json").write_text(json.dumps(results, indent=2) + "\n")
        (args.output / "benchmark.md").write_text(page(results) + "\n")
    print(page(results))
    met = sum(row["met"] for row in results["goals"])
    print(f"\nbenchmark: {met} of {len(results['goals'])} goals met; see {args.output}")


if __name__ == "__main__":
    main()
