"""Drives an agent and its guide over the test tracks; one table, and pictures beside it."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from tqdm import tqdm

from coil_rl.files import write_text
from coil_rl.report import animate_lines, draw_lines, markdown_table, write_csv
from coil_rl.train.build import build, build_env
from coil_rl.train.evaluation import PER_STEP, EvaluationResult, evaluate_policy, summarise
from coil_rl.train.guide_drives import drive_guides

COLUMNS = {
    "driver": ("driver", ""),
    "advice": ("advice", ""),
    "actions": ("actions", ""),
    "track": ("track", ""),
    "reward": ("reward", ".1f"),
    "lap_time": ("lap (s)", ".2f"),
    "smoothness": ("smoothness", ".3f"),
    "completed": ("completed", ".0%"),
    "crashed": ("crashed", ".0%"),
    "clearance": ("clearance (m)", ".2f"),
}


def evaluate_run(config: DictConfig, agent: TensorDictModuleBase | None, folder: Path, seed: int) -> None:
    """Evaluate and write `episodes.csv`, `lines.png`, `lines.gif`, `evaluation.md` (means) and, last, `evaluation.csv`.

    Each guide drives each track once; an agent once by its deterministic action, `evaluation.repeats` times by sampled
    ones if it samples, and once with each advice of `evaluation.advice` in place of what it was trained with.

    Args:
        config: of a run.
        agent: its policy; None for the guide alone.
        folder: where the files go.
        seed: of the sampled actions.
    """
    tracks = build(config.track.test, "track.test")
    names = [track.name for track in tracks]
    table: list[dict[str, Any]] = []
    episodes: list[dict[str, Any]] = []
    drives: dict[str, EvaluationResult] = {}

    def note(driven: EvaluationResult, driver: str, advice: str = "", actions: str = "deterministic") -> None:
        label = {"driver": driver, "advice": advice, "actions": actions}
        table.extend(label | row for row in summarise(driven.episodes))
        episodes.extend(label | row for row in driven.episodes)
        if actions == "deterministic":
            drives[f"{driver}, {advice}" if advice else driver] = driven

    for driver, driven in drive_guides(config, config.evaluation.env, names).items():
        note(driven, driver)
    torch.manual_seed(seed)
    with tqdm(unit="step", desc="evaluate", leave=False, mininterval=0.5) as bar:
        for advice, repeats in [] if agent is None else _plan(config, agent):
            bar.set_postfix_str(", ".join(filter(None, (config.label, advice))))
            # Cars of both kinds in one batch: a step takes as long for a few as for one.
            cars = torch.arange((1 + repeats) * len(tracks), device=config.device)
            env = build_env(config, {**config.evaluation.env, "num_cars": len(cars)}, advice=advice)
            sampled = repeats > 0 and cars >= len(tracks)
            driven = evaluate_policy(env, agent, sampled=sampled, names=names, tick=bar.update)
            note(driven[: len(tracks)], config.label, advice)
            if repeats:
                note(driven[len(tracks) :], config.label, advice, "sampled")
    write_csv(episodes, folder / "episodes.csv")
    lines = {driver: driven.lines for driver, driven in drives.items()}
    crashed = {driver: [row["crashed"] for row in driven.episodes] for driver, driven in drives.items()}
    draw_lines(tracks, lines, folder / "lines.png", crashed=crashed)
    if config.evaluation.gif:
        animate_lines(tracks, lines, folder / "lines.gif", rate=config.env.rate, crashed=crashed)
    columns = {key: value for key, value in COLUMNS.items() if key != "advice" or config.evaluation.advice}
    tasks = {key: key.removeprefix(PER_STEP) for key in table[0] if key.startswith(PER_STEP)}
    columns |= {key: (f"{task} (a step)", ".3f") for key, task in tasks.items()}
    write_text(folder / "evaluation.md", markdown_table(table, columns))
    write_csv(table, folder / "evaluation.csv")


def _plan(config: DictConfig, agent: TensorDictModuleBase) -> list[tuple[str, int]]:
    """What advice the agent gets, and how often it drives each track by sampled actions."""
    plan = [("", config.evaluation.repeats if hasattr(agent, "get_dist") else 0)]
    if config.method.transforms:
        plan += [(advice, 0) for advice in config.evaluation.advice]
    return plan


def is_evaluated(folder: Path) -> bool:
    """Whether all that `judge` writes is there."""
    return (folder / "evaluation.csv").exists()


def outcome(folder: Path) -> float:
    """Print what `judge` found; returns the mean reward of the deterministic agent, or else of the guide."""
    with (folder / "evaluation.csv").open(newline="") as file:
        means = [row for row in csv.DictReader(file) if row["track"] == "mean" and row["actions"] == "deterministic"]
    rows = [row for row in means if not row["advice"]]
    driver, reward, completed = rows[-1]["driver"], float(rows[-1]["reward"]), float(rows[-1]["completed"])
    print((folder / "evaluation.md").read_text().rstrip())
    print(f"{driver}: mean test reward {reward:.1f}, {completed:.0%} completed; see {folder}")
    return reward
