"""`coil-benchmark`: how fast cars drive and agents train, and how that compares with other ways to do it."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from coil_rl.benchmark.driving import measure_compiled, measure_driving, measure_operators
from coil_rl.benchmark.fresh import measure_memory, measure_start
from coil_rl.benchmark.picture import draw_driving
from coil_rl.benchmark.robot import measure_robot
from coil_rl.benchmark.summary import goals, summarise
from coil_rl.benchmark.training import measure_shares, measure_training
from coil_rl.benchmark.turns import Turns
from coil_rl.benchmark.yardsticks import measure_oracle, measure_sb3
from coil_rl.errors import UserError
from coil_rl.files import write_text
from coil_rl.programs import app
from coil_rl.train.build import learner_kind
from coil_rl.train.run_folder import versions

SETTINGS = ("device", "threads", "seed", "seconds", "repeats", "starts", "quick", "parts", "preset", "guide", "learner")

PARTS: Mapping[str, Callable[[DictConfig, Turns], Any]] = {
    "start": measure_start,
    "memory": measure_memory,
    "env": measure_driving,
    "training": measure_training,
    "shares": measure_shares,
    "robot": measure_robot,
    "oracle": measure_oracle,
    "sb3": measure_sb3,
    "profile": lambda config, _: measure_operators(config, config.compare_cars),
}


def benchmark(config: DictConfig) -> None:
    """Measure the parts that were asked for; print a page and leave it in the folder, with every number as JSON."""
    unknown = [part for part in config.parts if part not in PARTS]
    if unknown:
        raise UserError(f"parts: there is no {', '.join(unknown)}; there are {', '.join(PARTS)}")
    if learner_kind(config) != "agent":
        name = config.learner["_target_"].rpartition(".")[2]
        raise UserError(
            f"{name} does not learn from reward alone, as what is measured does; take another, as learner=ppo"
        )
    if config.quick:
        config.merge_with(config.when_quick)
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    folder = Path(config.run_dir)
    if (folder / "benchmark.json").exists():
        raise UserError(f"{folder} already holds a benchmark; choose another folder with hydra.run.dir=FOLDER")

    resolved: Any = OmegaConf.to_container(config, resolve=True)
    settings = {key: resolved[key] for key in SETTINGS}
    results: dict[str, Any] = {"versions": versions(), "settings": settings, "goals": []}
    plan = {name: PARTS[name] for name in PARTS if name in config.parts}
    if config.compile:
        plan["compiled"] = measure_compiled
    # Before the profiler's first use: it tells the terminal about its own start and end.
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")
    with tqdm(plan.items(), unit="part", desc="benchmark", mininterval=0.5) as bar:
        turns = Turns(config.seconds, config.repeats, config.device, bar.set_postfix_str)
        for name, measure in bar:
            results[name] = measure(config, turns)
            # After each part, so that an interrupted run keeps what it has measured.
            results["goals"] = goals(results)
            _write(folder / "benchmark.json", json.dumps(results, indent=2))
    text = summarise(results)
    _write(folder / "benchmark.md", text)
    if "env" in results:
        one_car = results.get("oracle", {}).get("oracle_steps_per_s")
        draw_driving(results["env"], folder / "benchmark.png", one_car)
    print(text)
    met = sum(row["met"] for row in results["goals"])
    print(f"\nbenchmark: {met} of {len(results['goals'])} goals met; see {folder}")


def _write(path: Path, text: str) -> None:
    write_text(path, text)


def main() -> None:
    """Entry point."""
    app.run(benchmark, "benchmark")


if __name__ == "__main__":
    main()
