"""Run folders as coil-train writes them, without a run."""

import json
import math
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
import yaml
from omegaconf import OmegaConf
from programs import composed

import coil_rl.config.schema  # noqa: F401 registers the configuration schema
from coil_rl.config.parts import build_learner, env_maker
from coil_rl.report import write_csv
from coil_rl.run import checkpoint

Row = dict[str, Any]
MEASURES = yaml.safe_load((files("coil_rl.conf") / "measures" / "driving.yaml").read_text())
OTHERS = {"lap_time": 50.0, "smoothness": 0.1, "completed": 1.0, "crashed": 0.0, "clearance": 0.3}


def driven(
    driver: str,
    rewards: Mapping[str, float],
    actions: str = "deterministic",
    advice: str = "",
    **others: float,
) -> list[Row]:
    """Return the rows of one driver: a row per case, and their mean."""
    row = {"driver": driver, "advice": advice, "actions": actions}
    rows = [
        row | {"case": case, "reward": reward} | OTHERS | others for case, reward in rewards.items()
    ]
    return [*rows, rows[0] | {"case": "mean", "reward": sum(rewards.values()) / len(rewards)}]


def make_run(
    folder: Path,
    label: str,
    seed: int,
    rows: Sequence[Row] | None,
    needs_guide: bool | None = True,
    guide: float = 300.0,
    settings: Mapping[str, Any] | None = None,
) -> Path:
    """Write a run; without rows it is not finished."""
    folder.mkdir(parents=True)
    config: Row = {"seed": seed, "label": label, "evaluation": {"measures": MEASURES}}
    config["method"] = {"name": "any", "needs_guide": needs_guide}
    config |= settings or {}
    (folder / "config.yaml").write_text(json.dumps(config))  # JSON is YAML
    (folder / "guide_return.json").write_text(json.dumps({"guide": guide}))
    curve = []
    for n in range(1000, 20_001, 1000):
        value = 400 * (1 - math.exp(-n / 5000)) + seed
        curve.append({"frames": n, "evaluation/return": value, "selection/return": value - 1})
    write_csv(curve, folder / "metrics.csv")
    if rows is not None:
        write_csv(rows, folder / "evaluation.csv")
    return folder


def make_sweep(folder: Path) -> Path:
    """Write three seeds of coil, better than its guide, and of ppo, better than coil.

    Two more runs are unfinished.
    """
    guide = driven("guide", {"a": 500.0, "b": 600.0})
    for seed in range(3):
        coil = driven("coil", {"a": 520.0 + seed, "b": 620.0 + seed}, smoothness=0.2)
        coil += driven("coil", {"a": 510.0 + seed, "b": 610.0 + seed}, "sampled")
        crash = {"lap_time": math.nan, "completed": 0.0, "crashed": 1.0}
        coil += driven("coil", {"a": -100.0, "b": -200.0 - seed}, advice="zeroed", **crash)
        make_run(folder / f"{seed}_coil", "coil", seed, guide + coil)
        ppo = driven("ppo", {"a": 540.0 + seed, "b": 640.0 + seed})
        ppo += driven("ppo", {"a": 505.0, "b": 615.0}, "sampled")
        make_run(folder / f"{seed + 3}_ppo", "ppo", seed, guide + ppo, needs_guide=False)
    make_run(folder / "6_coil", "coil", 3, None)
    make_run(folder / "7_ppo", "ppo", 3, None)
    return folder


def make_untrained_run(folder: Path, *overrides: str) -> Path:
    """Write the configuration and the untrained policy of a run."""
    folder.mkdir()
    torch.manual_seed(0)
    config = composed(*overrides, f"run_dir={folder}")
    if config.method.observes is not None:
        policy = build_learner(config, env_maker(config)()).policy
        for which in ("last", "handed_over")[: 2 if config.delivery == "tested" else 1]:
            checkpoint.save(policy.state_dict(), folder / f"policy_{which}.pt")
    saved = OmegaConf.create(OmegaConf.to_container(config, resolve=True))
    saved.logger = None
    OmegaConf.save(saved, folder / "config.yaml")
    return folder
