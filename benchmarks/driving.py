"""Env steps per second with and without a guide, slowest operators, and the robot's perception."""

from __future__ import annotations

import itertools
import os
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Barrier
from pathlib import Path

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch.profiler import profile
from torchrl.envs import EnvBase, TransformedEnv

from benchmarks.timing import Row, measure, median_ratio, medians, synchronise
from coil_rl import compose_train
from coil_rl.compiled import compile_steps
from coil_rl.config.parts import build_bare_env, build_guides
from coil_rl.envs import (
    Perception,
    SimulatedRobotEnv,
    read_recording,
    save_drive,
    simulated_cone_classifier,
    simulated_drive,
)
from coil_rl.transforms import GuideActions

ROBOTS = 256  # in the simulator, side by side


def train_config(args: Namespace, method: str, *more: str) -> DictConfig:
    """Return the configuration of `coil-train` with the overrides of the command line."""
    fixed = [f"method={method}", f"device={args.device}", "logger=none", "run_dir=unused"]
    return compose_train([*fixed, *args.overrides, *more])


def driving_env(args: Namespace, cars: int, guide: bool) -> EnvBase:
    """Return the configured env, with or without the advice of the guide at every step."""
    config = train_config(args, "coil")
    env = build_bare_env(config, {"num_envs": cars})
    return TransformedEnv(env, GuideActions(build_guides(config))) if guide else env


class Driving:
    """Steps of an env with resets; each call returns the number of cars.

    Args:
        env: batched env.
        follow: take the advised actions in place of random ones.
    """

    def __init__(self, env: EnvBase, follow: bool = False) -> None:
        self.env, self.follow, self.cars, self.steps = env, follow, env.batch_size.numel(), 0
        self.ended = torch.zeros((), dtype=torch.int64, device=env.device)
        with torch.no_grad():
            self.state = env.reset()

    @torch.no_grad()
    def __call__(self) -> int:
        """Step all cars once."""
        random = torch.rand(*self.env.batch_size, 1, device=self.env.device) * 2 - 1
        self.state["action"] = self.state["guide_action"][..., 0, :] if self.follow else random
        step, self.state = self.env.step_and_maybe_reset(self.state)
        self.ended += step["next", "done"].sum()
        self.steps += 1
        return self.cars

    def until_resets(self) -> Driving:
        """Drive until the first episodes end, so that resets are measured too."""
        while not self.ended:
            self()
        self.ended.zero_()
        self.steps = 0
        return self


def measure_driving(args: Namespace) -> list[Row]:
    """Return a row for each number of cars."""
    rows = []
    for cars in args.cars:
        bare = Driving(driving_env(args, cars, guide=False)).until_resets()
        guided = Driving(driving_env(args, cars, guide=True)).until_resets()
        following = Driving(driving_env(args, cars, True), follow=True)
        rates = measure(args, {"env": bare, "advice": guided, "follow": following})
        median = medians(rates)
        rows.append(
            {
                "cars": cars,
                "env steps/s": median["env"],
                "with advice": median["advice"],
                "guide drives": median["follow"],
                "ms per batched step": 1e3 * cars / median["env"],
                "ms with advice": 1e3 * cars / median["advice"],
                "resets in 1000 steps": 1e3 * float(guided.ended) / (cars * guided.steps),
                "rounds": rates,
            }
        )
    return rows


def measure_guide(args: Namespace, states: int = 8) -> list[Row]:
    """Return the CPU time of the guide alone in states of its drive, for each size of a batch."""
    rows = []
    for cars, _ in args.batches:
        driving = Driving(driving_env(args, cars, guide=True), follow=True)
        (guide,) = build_guides(train_config(args, "coil")).values()
        seen = []
        for _ in range(states):
            for _ in range(4):
                driving()
            seen.append(driving.state.select(*guide.in_keys, strict=False))

        def advise(guide: TensorDictModuleBase = guide, seen: list[TensorDictBase] = seen) -> int:
            with torch.no_grad():
                for state in seen:
                    guide(state.copy())
            return len(seen) * seen[0].numel()

        rates = measure(args, {"guide": advise}, time.process_time)
        rows.append({"cars": cars, "us a frame": 1e6 / medians(rates)["guide"], "rounds": rates})
    return rows


def measure_cores(args: Namespace) -> list[Row]:
    """Return the speed of cars that the guide drives, shared by one process on each core."""
    count, context = os.cpu_count() or 1, torch.multiprocessing.get_context("spawn")
    cars, queue = args.compare_cars // count, context.SimpleQueue()
    torch.multiprocessing.spawn(
        _drive_at_once, (args, cars, context.Barrier(count), queue), nprocs=count
    )
    by_process = [queue.get() for _ in range(count)]
    rates = {"together (steps/s)": [sum(turn) for turn in zip(*by_process, strict=True)]}
    return [{"cars": cars * count, "processes": count, **medians(rates), "rounds": rates}]


def _drive_at_once(
    process: int, args: Namespace, cars: int, barrier: Barrier, queue: SimpleQueue
) -> None:
    """Put the steps per second of each turn into the queue.

    All processes begin a turn at the same time.
    """
    torch.set_num_threads(1)
    driving = Driving(driving_env(args, cars, guide=True), follow=True)
    turn, rates = Namespace(repeats=1, seconds=args.seconds / args.repeats), []
    for _ in range(args.repeats):
        barrier.wait()
        rates += measure(turn, {"drive": driving})["drive"]
    queue.put(rates)


def measure_compiled(args: Namespace) -> list[Row]:
    """Return the speed of the guide's drives with compiled steps beside that without."""
    rows = []
    for cars in args.compile:
        env = driving_env(args, cars, guide=True)
        compile_steps(env)
        compiled, start = Driving(env, follow=True), time.perf_counter()
        compiled()
        synchronise()
        seconds = time.perf_counter() - start
        eager = Driving(driving_env(args, cars, guide=True), follow=True)
        rates = measure(args, {"eager": eager, "compiled": compiled})
        ratio = median_ratio(rates["compiled"], rates["eager"])
        row = {"cars": cars, **medians(rates), "ratio": ratio, "compiling (s)": seconds}
        rows.append({**row, "rounds": rates})
    return rows


def profile_operators(args: Namespace, steps: int = 20) -> str:
    """Return the profiler's table of the slowest operators in batched steps with advice.

    They are ordered by the time of their own.
    """
    driving = Driving(driving_env(args, args.compare_cars, guide=True)).until_resets()
    device = "device" if args.device.startswith("cuda") else "cpu"
    with profile() as profiler:
        for _ in range(steps):
            driving()
        synchronise()
    return str(profiler.key_averages().table(sort_by=f"self_{device}_time_total", row_limit=10))


def measure_robot(args: Namespace) -> list[Row]:
    """Return scans per second of CPU time, for a simulated lap with 360 points a scan."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lap.mcap"
        save_drive(simulated_drive("both", 0), path)
        recording = read_recording(path)
        ranges, angles = recording.ranges, recording.angles(0)
        perceive = Perception(simulated_cone_classifier())
        scan = itertools.cycle(range(len(ranges)))

        def single_scan() -> int:
            row = next(scan)
            perceive(ranges[row : row + 1], angles)
            return 1

        def whole_recording() -> int:
            perceive(ranges, angles)
            return len(ranges)

        simulated = Driving(SimulatedRobotEnv(num_envs=ROBOTS, starts=32, time_limit=20.0))
        subjects: dict[str, Callable[[], int]] = {
            f"simulator, {ROBOTS} robots": simulated,
            "reading MCAP": lambda: len(read_recording(path).ranges),
            "perception, whole recording": whole_recording,
            "perception, single scans": single_scan,
        }
        rates = measure(args, subjects, time.process_time)
    return [{"subject": name, "scans/s": rate} for name, rate in medians(rates).items()]
