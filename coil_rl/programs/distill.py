"""`coil-distill`: turn each guide into a network that imitates it, and say how well it does."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from coil_rl.programs import app
from coil_rl.report import markdown_table
from coil_rl.train import distillation, run
from coil_rl.train.build import build_guides

COLUMNS = {
    "guide": ("guide", ""),
    "samples": ("samples", ".0f"),
    "r2_training": ("R^2, learned from", ".3f"),
    "r2_ahead": ("R^2, where it drives", ".3f"),
    "mse_ahead": ("squared error there", ".5f"),
    "own": ("guide's reward", ".1f"),
    "reward": ("proxy's reward", ".1f"),
    "completed": ("completed", ".0%"),
    "folder": ("folder", ""),
}


def distill(config: DictConfig) -> float:
    """Make the proxy of every guide that is not there yet; returns the lowest mean test reward of one."""
    table = []
    for name in build_guides(config):
        wanted = distillation.proxy_config(config, name)
        reward = run.run(wanted, wait=True)
        table.append({"guide": name, "reward": reward, **_found(Path(wanted.run_dir))})
    print(markdown_table(table, COLUMNS))
    worst = min(table, key=lambda row: float(row["reward"]))
    print(f"distill: {len(table)} made; the worst drives for {worst['reward']:.1f}, its guide for {worst['own']:.1f}")
    return float(worst["reward"])


def _found(folder: Path) -> dict[str, Any]:
    with (folder / "metrics.csv").open(newline="") as file:
        *_, last = csv.DictReader(file)
    learned = {name: float(last[f"learner/{name}"]) for name in COLUMNS if f"learner/{name}" in last}
    with (folder / "evaluation.csv").open(newline="") as file:
        guide, proxy = (row for row in csv.DictReader(file) if row["track"] == "mean")
    return learned | {"own": float(guide["reward"]), "completed": float(proxy["completed"]), "folder": str(folder)}


def main() -> None:
    """Entry point."""
    app.run(distill, "distill")


if __name__ == "__main__":
    main()
