"""`coil-distill`: train a network that imitates each guide, and print how well it does."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from coil_rl.programs import app

COLUMNS = {
    "guide": ("guide", ""),
    "samples": ("samples", ".0f"),
    "r2_training": ("R^2, training data", ".3f"),
    "r2_ahead": ("R^2, on its own drives", ".3f"),
    "mse_ahead": ("squared error there", ".5f"),
    "guide_reward": ("guide's reward", ".1f"),
    "reward": ("proxy's reward", ".1f"),
    "completed": ("completed", ".0%"),
    "folder": ("folder", ""),
}


def distill(config: DictConfig) -> float:
    """Train the missing proxies of all guides, and return the lowest mean test reward of a proxy."""
    from coil_rl.report import markdown_table
    from coil_rl.train import distillation
    from coil_rl.train.build import build_guides
    from coil_rl.train.run import run

    table = []
    for name in build_guides(config):
        proxy_config = distillation.proxy_config(config, name)
        reward = run(proxy_config, wait=True)
        table.append({"guide": name, "reward": reward, **_measures(Path(proxy_config.run_dir))})
    print(markdown_table(table, COLUMNS))
    worst = min(table, key=lambda row: float(row["reward"]))
    print(
        f"distill: made {len(table)}; the lowest mean reward is {worst['reward']:.1f}, "
        f"that of its guide {worst['guide_reward']:.1f}"
    )
    return float(worst["reward"])


def _measures(folder: Path) -> dict[str, Any]:
    with (folder / "metrics.csv").open(newline="") as file:
        *_, last = csv.DictReader(file)
    learned = {name: float(last[f"learner/{name}"]) for name in COLUMNS if f"learner/{name}" in last}
    with (folder / "evaluation.csv").open(newline="") as file:
        guide, proxy = (row for row in csv.DictReader(file) if row["track"] == "mean")
    rewards = {"guide_reward": float(guide["reward"]), "completed": float(proxy["completed"])}
    return learned | rewards | {"folder": str(folder)}


def main() -> None:
    """Entry point."""
    app.run(distill, "distill")


if __name__ == "__main__":
    main()
