"""Other people's ways to do the same: one car in NumPy and SciPy, and Stable-Baselines3 on the Gymnasium env."""

from __future__ import annotations

import importlib.util
import math
import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from omegaconf import DictConfig, OmegaConf

import coil_rl
from coil_rl.benchmark.driving import Driving, drive_env
from coil_rl.benchmark.training import Training, has_yardstick
from coil_rl.benchmark.turns import Turns, median_ratio
from coil_rl.train.build import build

ORACLE = Path(coil_rl.__file__).resolve().parents[1] / "tests" / "oracle.py"
ORACLE_STEPS = 20
SB3_ENVS = (1, 8)


def measure_oracle(config: DictConfig, turns: Turns) -> dict[str, Any]:
    """Env steps per second with the guide: one car in NumPy and SciPy, and ours at `compare_cars`.

    In both the guide drives.
    """
    if not ORACLE.is_file():
        return {"not_measured": "no checkout: tests/oracle.py is not part of the installed package"}
    ours = Driving(drive_env(config, config.compare_cars, guide=True), advised=True)
    rates = turns.rates({"oracle": one_car(_load(ORACLE), config), "ours": ours}, "one car in NumPy and SciPy: ")
    return {
        "cars": config.compare_cars,
        "oracle_steps_per_s": statistics.median(rates["oracle"]),
        "steps_per_s_with_guide": statistics.median(rates["ours"]),
        "ratio": median_ratio(rates["ours"], rates["oracle"]),
        "rounds": rates,
    }


def one_car(oracle: ModuleType, config: DictConfig) -> Callable[[], int]:
    """Drives `tests/oracle.py` on the training tracks in turn, each to the end."""
    options = {key: config.env[key] for key in ("rate", "spline", "smoothing", "cone_bonus", "held_steps", "laps")}
    spline = config.guide.get("spline", {})
    guide = {key: spline[key] for key in ("spline", "smoothing", "gain") if key in spline}
    cars = [oracle.OneCar(t.left, t.right, t.start, **options) for t in build(config.track.train, "track.train")]
    driven = 0

    def steps() -> int:
        nonlocal driven
        for _ in range(ORACLE_STEPS):
            car = cars[driven % len(cars)]
            outcome = car.step(oracle.guide_action(*car.cones(), car.steering, **guide))
            if outcome.terminated or outcome.truncated:
                driven += 1
                cars[driven % len(cars)].reset()
        return ORACLE_STEPS

    return steps


def _load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    # A dataclass asks for its own module while it is being made.
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def measure_sb3(config: DictConfig, turns: Turns) -> dict[str, Any]:
    """Frames per second of PPO: Stable-Baselines3 on its usual vectors of single envs, and ours at the first batch.

    It runs on the CPU, with networks as large as ours; everything else is its own default but for the length of a
    rollout, which is shorter so that a turn is.
    """
    if not has_yardstick(config):
        return {"not_measured": "Stable-Baselines3 runs PPO that steers by numbers: learner=ppo action=continuous"}
    if importlib.util.find_spec("stable_baselines3") is None or importlib.util.find_spec("gymnasium") is None:
        return {"not_measured": "Stable-Baselines3 is not installed: python -m pip install 'coil-rl[bench]'"}
    batch = config.batches[0]
    names = {f"stable-baselines3, {envs} envs" if envs > 1 else "stable-baselines3": envs for envs in SB3_ENVS}
    subjects: dict[str, Callable[[], int]] = {"ours": Training(config, "ppo", batch.cars, batch.steps)}
    subjects |= {name: _sb3(config, envs) for name, envs in names.items()}
    rates = turns.rates(subjects, "PPO: ")
    return {
        "cars": batch.cars,
        "steps": batch.steps,
        "ppo_frames_per_s": statistics.median(rates["ours"]),
        "stable_baselines3": [
            {
                "envs": envs,
                "frames_per_s": statistics.median(rates[name]),
                "ratio": median_ratio(rates["ours"], rates[name]),
            }
            for name, envs in names.items()
        ],
        "rounds": rates,
    }


def _sb3(config: DictConfig, envs: int) -> Callable[[], int]:
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from torch import nn

    from coil_rl.envs.gym import ConeTrackGym

    options = OmegaConf.to_container(config.env, resolve=True)
    if not isinstance(options, dict):
        raise TypeError("env must be a mapping")
    tracks = build(config.track.train, "track.train")
    given: dict[str, Any] = {
        str(key): value for key, value in options.items() if key not in ("_target_", "tracks", "num_cars", "device")
    }
    vector = make_vec_env(ConeTrackGym, envs, env_kwargs={"tracks": tracks, **given})
    hidden = list(config.learner.hidden)
    policy = {
        "net_arch": {"pi": hidden, "vf": hidden},
        "activation_fn": nn.Tanh,
        "log_std_init": math.log(config.learner.action_scale),
    }
    model = PPO("MlpPolicy", vector, n_steps=config.sb3_frames // envs, policy_kwargs=policy, device="cpu")

    def update() -> int:
        model.learn(config.sb3_frames, reset_num_timesteps=False)
        return int(config.sb3_frames)

    return update
