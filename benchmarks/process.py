"""Start-up time and memory of fresh processes.

They are fresh because modules are imported only once, and peak memory never decreases.

`python -m benchmarks.process CARS STEPS DEVICE THREADS` prints one line of JSON.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from argparse import Namespace
from pathlib import Path

from benchmarks.timing import Row

ROOT = Path(__file__).parents[1]


def measure_processes(args: Namespace) -> list[Row]:
    """Return a row for each number of cars in `memory_cars`, and one with an update of COIL.

    The update is of the first of `batches`, which are pairs of a number of cars and one of steps.
    """
    rows = []
    for cars, steps in [*((cars, 0) for cars in args.memory_cars), args.batches[0]]:
        options = map(str, (cars, steps, args.device, args.threads))
        command = [sys.executable, "-m", __name__, *options]
        done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
        numbers = json.loads(done.stdout.splitlines()[-1])
        rows.append({"cars": cars, "trained steps": steps, **numbers})
    return rows


def main(cars: int, steps: int, device: str, threads: int) -> Row:
    """Import, build an env with advice and step it, and do one update of COIL if asked.

    Args:
        cars: rows of the env.
        steps: of each car in the rollout of the update; 0 for no update.
        device: of the env.
        threads: of torch.
    """
    start = time.perf_counter()
    import torch
    from torchrl.envs import Compose, RewardSum, TransformedEnv

    from coil_rl.envs import ConeTrackEnv, shipped_tracks
    from coil_rl.guides import SplineGuide
    from coil_rl.learners import PPO
    from coil_rl.run.rollout import Rollout
    from coil_rl.transforms import GuideActions

    torch.set_num_threads(threads)
    imported = time.perf_counter()
    transforms = Compose(GuideActions({"guide": SplineGuide()}), RewardSum())
    env = TransformedEnv(ConeTrackEnv(shipped_tracks("train"), cars, device=device), transforms)
    built = time.perf_counter()
    reset_peak()  # building the maps of the tracks needs more memory than a few cars
    with torch.no_grad():
        after = env.rand_step(env.reset())
    float(after["next", "reward"].sum())  # waits for the device
    stepped = time.perf_counter()
    if steps:
        learner = PPO(env, ["observation", "guide_action"], epochs=1)
        learner.update(Rollout(env, learner.policy, steps, learner.keys).collect())
    else:
        env.rollout(5, break_when_any_done=False)
    state = [each for each in env.base_env.buffers() if cars in each.shape]
    state_bytes = sum(each.numel() * each.element_size() for each in state)
    on_gpu = device.startswith("cuda")
    return {
        "import (s)": imported - start,
        "building (s)": built - imported,
        "first step (s)": stepped - built,
        "state per car (B)": state_bytes / cars,
        "peak (MB)": peak_memory(),
        "device peak (MB)": torch.cuda.max_memory_allocated() / 1e6 if on_gpu else None,
    }


def peak_memory() -> float | None:
    """Return the peak resident memory since `reset_peak` in MB; None if it is unknown.

    The peak of `getrusage` would include the parent process.
    """
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    peaks = [int(line.split()[1]) / 1e3 for line in lines if line.startswith("VmHWM:")]
    return peaks[0] if peaks else None


def reset_peak() -> None:
    """Reset the peak of memory, on Linux."""
    if Path("/proc/self/clear_refs").exists():
        Path("/proc/self/clear_refs").write_text("5")


if __name__ == "__main__":
    print(json.dumps(main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3], int(sys.argv[4]))))
