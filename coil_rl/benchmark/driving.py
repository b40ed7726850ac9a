"""How fast cars drive: env steps per second, with and without the guide's advice, and what bounds it."""

from __future__ import annotations

import statistics
import time
from typing import Any

import torch
from omegaconf import DictConfig
from torch.profiler import ProfilerActivity, profile
from torchrl.envs import Compose, EnvBase, TransformedEnv

from coil_rl.benchmark.turns import Turns, synchronise
from coil_rl.train.build import build_all, build_bare_env

OPERATORS = 10


class Driving:
    """Cars that steer at random or as they are advised, with resets; a call returns how many cars made a step.

    Args:
        env: batched env.
        advised: follow the advice.
    """

    def __init__(self, env: EnvBase, advised: bool = False) -> None:
        self.env, self.advised, self.cars = env, advised, env.batch_size.numel()
        self.steps = 0
        self.ended = torch.zeros((), dtype=torch.int64, device=env.device)
        with torch.no_grad():
            self.state = env.reset()

    @torch.no_grad()
    def __call__(self) -> int:
        """One step of all cars."""
        drawn = torch.rand(*self.env.batch_size, 1, device=self.env.device) * 2 - 1
        self.state["action"] = self.state["guide_action"][..., 0, :] if self.advised else drawn
        step, self.state = self.env.step_and_maybe_reset(self.state)
        self.ended += step["next", "done"].sum()
        self.steps += 1
        return self.cars

    def until_some_crash(self) -> Driving:
        """Drive on until episodes have begun to end: before that there is nothing to reset."""
        while not self.ended:
            self()
        self.ended.zero_()
        self.steps = 0
        return self

    @property
    def resets(self) -> float:
        """Share of the cars that were reset in a step, so far."""
        return float(self.ended) / (self.cars * self.steps)


def drive_env(config: DictConfig, cars: int, guide: bool) -> EnvBase:
    """The configured env, with or without the configured guide asked at every step."""
    env = build_bare_env(config, {"num_cars": cars})
    if not guide:
        return env
    return TransformedEnv(env, Compose(*build_all(config.methods.coil.method.transforms, "methods.coil.transforms")))


def measure_driving(config: DictConfig, turns: Turns) -> list[dict[str, Any]]:
    """One row a batch size: steps per second without advice, with it, and where the guide drives."""
    rows = []
    for cars in config.cars:
        turns.tick(f"{cars} cars, until some crash")
        subjects = {name: Driving(drive_env(config, cars, name == "guide")) for name in ("bare", "guide")}
        for subject in subjects.values():
            subject.until_some_crash()
        subjects["driven"] = Driving(drive_env(config, cars, True), advised=True)
        rates = turns.rates(subjects, f"{cars} cars, ")
        without, with_guide, driven = (statistics.median(rates[name]) for name in ("bare", "guide", "driven"))
        rows.append(
            {
                "cars": cars,
                "steps_per_s": without,
                "steps_per_s_with_guide": with_guide,
                "steps_per_s_guide_drives": driven,
                "ms_per_batched_step": 1e3 * cars / without,
                "ms_per_batched_step_with_guide": 1e3 * cars / with_guide,
                "resets_per_1000_steps": 1e3 * subjects["guide"].resets,
                "rounds": rates,
            }
        )
    return rows


def measure_compiled(config: DictConfig, turns: Turns) -> list[dict[str, Any]]:
    """The same under `torch.compile`, beside eager code, and how long it took to compile."""
    rows = []
    for cars in config.compile:
        env = drive_env(config, cars, guide=True)
        env.compile(warmup=3)
        turns.tick(f"{cars} cars, compiling")
        compiled = Driving(env)
        start = time.perf_counter()
        # What is compiled is reset too, and a reset that differs would be compiled once more.
        compiled.until_some_crash()
        synchronise(config.device)
        compiling = time.perf_counter() - start
        rates = turns.rates({"eager": Driving(drive_env(config, cars, guide=True)), "compiled": compiled})
        eager, fast = (statistics.median(rates[name]) for name in ("eager", "compiled"))
        rows.append(
            {
                "cars": cars,
                "steps_per_s_with_guide": eager,
                "steps_per_s_with_guide_compiled": fast,
                "compile_s": compiling,
                "rounds": rates,
            }
        )
    return rows


def measure_operators(config: DictConfig, cars: int, steps: int = 20) -> dict[str, Any]:
    """The operators that take most of a batched step with the guide, by their own time under the profiler."""
    driving = Driving(drive_env(config, cars, guide=True)).until_some_crash()
    cuda = config.device.startswith("cuda")
    activities = [ProfilerActivity.CPU] + [ProfilerActivity.CUDA] * cuda
    with profile(activities=activities) as profiler:
        for _ in range(steps):
            driving()
        synchronise(config.device)
    events = [event for event in profiler.key_averages() if event.key.startswith("aten::")]
    own = {event.key: event.self_device_time_total if cuda else event.self_cpu_time_total for event in events}
    total = sum(own.values())
    calls = {event.key: event.count for event in events}
    slowest = sorted(own, key=lambda key: own[key], reverse=True)[:OPERATORS]
    return {
        "cars": cars,
        "operator_calls_per_step": sum(calls.values()) / steps,
        "operators": [
            {
                "operator": key,
                "calls_per_step": calls[key] / steps,
                "ms_per_step": own[key] / steps / 1e3,
                "share": own[key] / total,
            }
            for key in slowest
        ],
    }
