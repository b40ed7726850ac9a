"""Drives an agent and its guide over the test tracks; one table, and pictures beside it."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from tqdm import tqdm

from coil_rl.build import build, build_env, build_guide
from coil_rl.evaluation import Drive, drive, summarise
from coil_rl.files import whole_file
from coil_rl.report import animate_lines, draw_lines, markdown_table, write_csv

COLUMNS = {
    "driver": ("driver", ""),
    "actions": ("actions", ""),
    "track": ("track", ""),
    "reward": ("reward", ".1f"),
    "lap_time": ("lap (s)", ".2f"),
    "smoothness": ("smoothness", ".3f"),
    "completed": ("completed", ".0%"),
    "crashed": ("crashed", ".0%"),
    "clearance": ("clearance (m)", ".2f"),
}


def judge(config: DictConfig, agent: TensorDictModuleBase | None, folder: Path) -> None:
    """Evaluate and write `episodes.csv`, `lines.png`, `lines.gif`, `evaluation.md` (means) and, last, `evaluation.csv`.

    The guide drives each track once; an agent once by its deterministic action and `evaluation.repeats` times by
    sampled ones.

    Args:
        config: of a run.
        agent: its policy; None for the guide alone.
        folder: where the files go.
    """
    tracks = build(config.track.test, "track.test")
    names = [track.name for track in tracks]
    plan: list[tuple[str, str, TensorDictModuleBase, int]] = [("guide", "deterministic", build_guide(config), 1)]
    if agent is not None:
        plan.append((config.method.name, "deterministic", agent, 1))
        plan.append((config.method.name, "sampled", agent, config.evaluation.repeats))
    table: list[dict[str, Any]] = []
    episodes: list[dict[str, Any]] = []
    drives: dict[str, Drive] = {}
    with tqdm(unit="step", desc="evaluate", leave=False, mininterval=0.5) as bar:
        for driver, actions, policy, repeats in plan:
            bar.set_postfix_str(f"{driver}, {actions}")
            overrides: Mapping[str, Any] = {**config.evaluation.env, "num_cars": repeats * len(tracks)}
            env = build_env(config, overrides, observed=policy is agent)
            driven = drive(env, policy, sampled=actions == "sampled", names=names, tick=bar.update)
            label = {"driver": driver, "actions": actions}
            table += [label | row for row in summarise(driven.episodes)]
            episodes += [label | row for row in driven.episodes]
            if actions == "deterministic":
                drives[driver] = driven
    write_csv(episodes, folder / "episodes.csv")
    lines = {driver: driven.lines for driver, driven in drives.items()}
    crashed = {driver: [row["crashed"] for row in driven.episodes] for driver, driven in drives.items()}
    draw_lines(tracks, lines, folder / "lines.png", crashed=crashed)
    if config.evaluation.gif:
        animate_lines(tracks, lines, folder / "lines.gif", rate=config.env.rate, crashed=crashed)
    with whole_file(folder / "evaluation.md") as unfinished:
        unfinished.write_text(markdown_table(table, COLUMNS) + "\n")
    write_csv(table, folder / "evaluation.csv")


def is_judged(folder: Path) -> bool:
    """Whether all that `judge` writes is there."""
    return (folder / "evaluation.csv").exists()


def outcome(folder: Path) -> float:
    """Print what `judge` found; returns the mean reward of the deterministic agent, or else of the guide."""
    with (folder / "evaluation.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["track"] == "mean" and row["actions"] == "deterministic"]
    driver, reward, completed = rows[-1]["driver"], float(rows[-1]["reward"]), float(rows[-1]["completed"])
    print((folder / "evaluation.md").read_text().rstrip())
    print(f"{driver}: mean test reward {reward:.1f}, {completed:.0%} completed; see {folder}")
    return reward
