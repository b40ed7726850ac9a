"""What a fresh process needs: time until the first step, and memory.

Run as a program of its own (`python -m coil_rl.benchmark.fresh CARS STEPS DEVICE THREADS`), because modules are
imported once and a peak of memory never comes down; it prints one line of JSON.
"""

from __future__ import annotations

import contextlib
import json
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from coil_rl.benchmark.turns import Turns

START_CARS = 64
STEPS = 5


def measure_start(config: DictConfig, turns: Turns) -> dict[str, Any]:
    """Seconds for importing, building an env of `START_CARS` and its first step with the guide's advice."""
    runs = []
    for _ in range(config.starts):
        turns.tick("start-up")
        runs.append(_child(config, START_CARS, 0))
    keys = ("import_s", "build_s", "first_step_s")
    medians = {key: statistics.median(run[key] for run in runs) for key in keys}
    return {"cars": START_CARS, **medians, "total_s": sum(medians.values()), "rounds": runs}


def measure_memory(config: DictConfig, turns: Turns) -> dict[str, Any]:
    """Bytes of state a car, growth of the peak a car, and the peak of a training at the first of the batches.

    The two numbers a car differ in what a step needs while it lasts and in what it returns.
    """
    batch = config.batches[0]
    few, many = config.memory_cars
    turns.tick("memory")
    small, large = (_child(config, cars, 0) for cars in (few, many))
    training = _child(config, batch.cars, batch.steps)
    found: dict[str, Any] = {"state_bytes_per_car": state_bytes_per_car(config.device)}
    key = "peak_device_bytes" if config.device.startswith("cuda") else "peak_bytes"
    if small[key] is not None:
        found["peak_bytes_per_car"] = (large[key] - small[key]) / (many - few)
    return found | {
        "building_peak_bytes": training["building_peak_bytes"],
        "training_peak_bytes": training["peak_bytes"],
        "training_peak_device_bytes": training["peak_device_bytes"],
        "training_cars": batch.cars,
        "training_steps": batch.steps,
    }


def state_bytes_per_car(device: str = "cpu") -> float:
    """Bytes of an env's buffers that a car more adds."""
    from coil_rl.envs import ConeTrackEnv, shipped_tracks

    def total(cars: int) -> int:
        env = ConeTrackEnv(shipped_tracks("train"), cars, device=device)
        return sum(buffer.numel() * buffer.element_size() for buffer in env.buffers())

    return (total(2000) - total(1000)) / 1000


def _child(config: DictConfig, cars: int, steps: int) -> dict[str, Any]:
    command = [sys.executable, "-m", __name__, str(cars), str(steps), config.device, str(config.threads)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed: {done.stderr.strip()}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def main(cars: int, steps: int, device: str, threads: int) -> dict[str, float | None]:
    """Import, build, step; with steps > 0 also one update of COIL on a batch of so many."""
    start = time.perf_counter()
    import torch
    from torchrl.envs import Compose, RewardSum, TransformedEnv

    from coil_rl.envs import ConeTrackEnv, shipped_tracks
    from coil_rl.guides import SplineGuide
    from coil_rl.learners import PPO
    from coil_rl.train.rollout import Rollout
    from coil_rl.transforms import GuideActions

    torch.set_num_threads(threads)
    imported = time.perf_counter()
    env = TransformedEnv(
        ConeTrackEnv(shipped_tracks("train"), cars, device=device),
        Compose(GuideActions({"guide": SplineGuide()}), RewardSum()),
    )
    built = time.perf_counter()
    building_peak = peak_memory()
    forget_peak()
    with torch.no_grad():
        state = env.rand_step(env.reset())
    float(state["next", "reward"].sum())  # waits for the device
    stepped = time.perf_counter()
    if steps:
        learner = PPO(env, ["observation", "guide_action"], epochs=1)
        learner.update(Rollout(env, learner.policy, steps, learner.keys).collect())
    else:
        env.rollout(STEPS, break_when_any_done=False)
    return {
        "import_s": imported - start,
        "build_s": built - imported,
        "first_step_s": stepped - built,
        "building_peak_bytes": building_peak,
        "peak_bytes": peak_memory(),
        "peak_device_bytes": torch.cuda.max_memory_allocated() if device.startswith("cuda") else None,
    }


def peak_memory() -> int | None:
    """Most bytes of main memory that this process has held since `forget_peak`; None where the system does not say."""
    try:
        # Not getrusage, whose peak starts at that of the parent where that was larger.
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:")), None)


def forget_peak() -> None:
    """Start the peak anew: building the tracks' maps takes more for a moment than a few cars ever do."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


if __name__ == "__main__":
    print(json.dumps(main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3], int(sys.argv[4]))))
