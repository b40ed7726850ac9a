"""Training speed beside yardsticks: PPO by hand, and Stable-Baselines3."""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from benchmarks.driving import train_config
from benchmarks.ppo import PlainPPO
from benchmarks.timing import Row, Stopwatch, Work, clock_of, measure, median_ratio, medians
from coil_rl.config.assemble import assemble
from coil_rl.config.nodes import build
from coil_rl.config.parts import build_bare_env, build_guides, build_learner, env_maker
from coil_rl.learners.off_policy import OffPolicy
from coil_rl.learners.ppo import PPO
from coil_rl.report.curves import learning
from coil_rl.report.runs import read_runs
from coil_rl.transforms import GuideActions

METHODS = ("ppo", "coil")
SHARES = ("env", "guide", "policy", "update")
SB3_ENVS = (1, 8)


class Training:
    """Training of `coil-train`; each call is one update and returns its frames.

    Replay of off-policy learners is filled first.

    Args:
        args: options of the benchmark.
        method: name of the method.
        cars: number of cars.
        steps: length of a rollout.
        compile: whether the update is compiled.
    """

    def __init__(
        self,
        args: Namespace,
        method: str,
        cars: int,
        steps: int,
        *,
        compile: bool = False,
    ) -> None:
        config = train_config(args, method, *(["learner.compile=true"] if compile else []))
        self.folder = tempfile.TemporaryDirectory()
        config.run_dir = self.folder.name
        run = assemble(config)
        run.budget = replace(run.budget, rows=cars, steps=steps)
        self.experiment = run.training(0)
        learner = self.experiment.learner
        while isinstance(learner, OffPolicy) and len(learner.buffer) < learner.starts:
            self()

    def __call__(self) -> int:
        """Collect a batch and learn from it."""
        self.experiment.update(0.0)
        return self.experiment.rollout.frames

    def watch(self, stopwatch: Stopwatch) -> None:
        """Time the parts of later updates, by the names of `SHARES`."""
        env, learner = self.experiment.rollout.env, self.experiment.learner
        stopwatch.wrap(env.base_env, "_step", "env")
        stopwatch.wrap(env.base_env, "_reset", "env")
        for transform in env.transform:
            if isinstance(transform, GuideActions):
                stopwatch.wrap(transform, "_call", "guide")
                stopwatch.wrap(transform, "_reset", "guide")
        stopwatch.wrap(learner.policy, "forward", "policy")
        stopwatch.wrap(learner, "update", "update")


def has_yardstick(args: Namespace) -> bool:
    """Return whether the configured learner is PPO with continuous actions."""
    config = train_config(args, "ppo")
    return not config.action and str(config.learner["_target_"]).endswith(".PPO")


def by_hand(args: Namespace, method: str, cars: int, steps: int) -> Work:
    """Return the update of `PlainPPO` with the same env and hyper-parameters."""
    config = train_config(args, method)
    guide = next(iter(build_guides(config).values())) if method == "coil" else None
    hyper_parameters = instantiate(config.learner, _target_="builtins.dict", _convert_="all")
    plain = PlainPPO(build_bare_env(config, {"num_envs": cars}), guide, steps, **hyper_parameters)

    def update() -> int:
        plain.update(plain.collect())
        return cars * steps

    return update


def measure_training(args: Namespace) -> list[Row]:
    """Return a row for each batch: frames per second with and without a guide, also by hand.

    On one thread of a CPU they are per second of its time.
    """
    rows = []
    by_hand_too = has_yardstick(args)
    for cars, steps in args.batches:
        rates = measure(args, _trainings(args, cars, steps, by_hand_too), clock_of(args))
        row: Row = {"batch": f"{cars} x {steps}", **medians(rates)}
        if by_hand_too:
            row["floor, ppo"] = floor_rate(args, cars * steps)
        row["cost of a frame, coil / ppo"] = median_ratio(rates["ppo"], rates["coil"])
        for kind in ("", " compiled"):
            for method in METHODS:
                name, yardstick = f"{method}{kind}", f"{method} by hand"
                if name in rates and yardstick in rates:
                    row[f"{name} / by hand"] = median_ratio(rates[name], rates[yardstick])
        rows.append({**row, "rounds": rates})
    return rows


def _trainings(args: Namespace, cars: int, steps: int, by_hand_too: bool) -> dict[str, Work]:
    """Return the updates of one batch size that are compared, by name."""
    subjects: dict[str, Work] = {}
    for method in METHODS:
        subjects[method] = Training(args, method, cars, steps)
    if args.compile_updates:
        for method in METHODS:
            subjects[f"{method} compiled"] = Training(args, method, cars, steps, compile=True)
    if by_hand_too:
        for method in METHODS:
            subjects[f"{method} by hand"] = by_hand(args, method, cars, steps)
    return subjects


def floor_rate(args: Namespace, frames: int) -> float:
    """Return the frames per second of PPO if it only multiplied matrices.

    The speed of its largest matrices is measured.
    """
    config = train_config(args, "ppo")
    learner = cast(PPO, build_learner(config, env_maker(config)(1)))  # see has_yardstick
    sizes = [parameter.numel() for parameter in learner.gradient.parameters if parameter.ndim == 2]
    # Of each weight a multiplication and an addition: forward, and twice backward; and once to act
    # and to value.
    operations = 2 * sum(sizes) * (3 * learner.sampler.epochs + 1)
    rows, width = max(frames // learner.sampler.count, 1), config.learner.hidden[0]
    left = torch.ones(rows, width, device=args.device)
    right = torch.ones(width, width, device=args.device)

    def multiply() -> int:
        torch.mm(left, right)
        return 2 * rows * width * width

    return medians(measure(args, {"matrices": multiply}))["matrices"] / operations


def measure_command(args: Namespace) -> list[Row]:
    """Return the times of two runs of `coil-train` with its defaults.

    The second run finds the code that the first one has compiled.
    """
    rows = []
    for name in ("first", "second"):
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "coil_rl.programs.train"]
            command += [f"hydra.run.dir={folder}/run", *args.overrides]
            command += [f"device={args.device}", *args.command]
            start = time.perf_counter()
            subprocess.run(command, check=True, capture_output=True)
            seconds = time.perf_counter() - start
            (run,) = read_runs([Path(folder)])
        found, training = learning(run), run.seconds or math.nan
        times = {"whole command (s)": seconds, "training (s)": training}
        times["to the guide's level (s)"] = found["until_guide"] / found["frames"] * training
        rows.append({"time": name, **times, "frames to the guide's level": found["until_guide"]})
    return rows


def measure_shares(args: Namespace, updates: int = 2) -> list[Row]:
    """Return the shares of the parts in the time of an update; the framework is the rest.

    The collection of the batch belongs to the update here.
    """
    rows = []
    for cars, steps in args.batches:
        for method in METHODS:
            training, stopwatch = Training(args, method, cars, steps), Stopwatch()
            training()
            training.watch(stopwatch)
            start = time.perf_counter()
            for _ in range(updates):
                training()
            total = time.perf_counter() - start
            shares = {name: stopwatch.seconds.get(name, 0.0) / total for name in SHARES}
            shares["framework"] = 1 - sum(shares.values())
            rows.append({"method": method, "batch": f"{cars} x {steps}", **shares})
    return rows


def measure_sb3(args: Namespace) -> list[Row]:
    """Return frames per second of PPO beside Stable-Baselines3 on the CPU, which has single envs.

    The networks have the same size; other values are its defaults, with a shorter rollout.
    """
    if not has_yardstick(args):
        return [{"not measured": "Stable-Baselines3 runs PPO with continuous actions"}]
    if find_spec("stable_baselines3") is None:
        reason = "Stable-Baselines3 is not installed: python -m pip install 'coil-rl[bench]'"
        return [{"not measured": reason}]
    (cars, steps), *_ = args.batches
    subjects: dict[str, Work] = {"ours": Training(args, "ppo", cars, steps)}
    subjects |= {str(envs): sb3(args, envs) for envs in SB3_ENVS}
    rates = measure(args, subjects)
    median = medians(rates)
    rows = []
    for envs in SB3_ENVS:
        row = {
            "envs": envs,
            "frames/s": median[str(envs)],
            f"ours, {cars} x {steps}": median["ours"],
        }
        ratio = median_ratio(rates["ours"], rates[str(envs)])
        rows.append({**row, "ratio": ratio, "rounds": rates})
    return rows


def sb3(args: Namespace, envs: int) -> Work:
    """Return an update of PPO of Stable-Baselines3."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from torch import nn

    from coil_rl.envs.gym import ConeTrackGym

    config = train_config(args, "ppo")
    options: Any = OmegaConf.to_container(config.env, resolve=True)
    for key in ("_target_", "num_envs", "device"):
        options.pop(key, None)
    options["tracks"] = build(config.track.train, "track.train")
    hidden = list(config.learner.hidden)
    policy: dict[str, Any] = {"net_arch": {"pi": hidden, "vf": hidden}, "activation_fn": nn.Tanh}
    policy["log_std_init"] = math.log(config.learner.action_scale)
    vector = make_vec_env(ConeTrackGym, envs, env_kwargs=options)
    model = PPO(
        "MlpPolicy", vector, n_steps=args.sb3_frames // envs, policy_kwargs=policy, device="cpu"
    )

    def update() -> int:
        model.learn(args.sb3_frames, reset_num_timesteps=False)
        return int(args.sb3_frames)

    return update
