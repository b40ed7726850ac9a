"""Evaluation of a run: its agent and its guides on the test tracks, as tables and figures."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from tqdm import tqdm

from coil_rl.errors import file_of_a_run
from coil_rl.files import write_text
from coil_rl.report import animate_lines, draw_lines, markdown_table, write_csv
from coil_rl.report.runs import PER_STEP
from coil_rl.train.build import build, build_env, build_guided_env, build_guides, env_node
from coil_rl.train.evaluation import EvaluationResult, evaluate_policy, summarise

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

    Each guide drives each track once. An agent drives it once with deterministic actions, `evaluation.repeats` times
    with sampled ones if it samples, and once with each advice of `evaluation.advice` instead of its own.

    The agent is the policy of the run, or None for the guides alone; `seed` is that of the sampled actions.
    """
    tracks = build(config.track.test, "track.test")
    names = [track.name for track in tracks]
    table: list[dict[str, Any]] = []
    episodes: list[dict[str, Any]] = []
    drives: dict[str, EvaluationResult] = {}

    def add(result: EvaluationResult, driver: str, advice: str = "", actions: str = "deterministic") -> None:
        label = {"driver": driver, "advice": advice, "actions": actions}
        table.extend(label | row for row in summarise(result.episodes))
        episodes.extend(label | row for row in result.episodes)
        if actions == "deterministic":
            drives[f"{driver}, {advice}" if advice else driver] = result

    for driver, result in drive_guides(config, config.evaluation.env, names).items():
        add(result, driver)
    torch.manual_seed(seed)
    with tqdm(unit="step", desc="evaluate", leave=False, mininterval=0.5) as bar:
        for advice, repeats in [] if agent is None else _plan(config, agent):
            bar.set_postfix_str(", ".join(filter(None, (config.label, advice))))
            # Deterministic and sampling cars in one batch: the time of a step hardly depends on its size.
            cars = torch.arange((1 + repeats) * len(tracks), device=config.device)
            env = build_env(config, {**config.evaluation.env, "num_cars": len(cars)}, advice=advice)
            sampled = repeats > 0 and cars >= len(tracks)
            result = evaluate_policy(env, agent, sampled=sampled, names=names, tick=bar.update)
            add(result[: len(tracks)], config.label, advice)
            if repeats:
                add(result[len(tracks) :], config.label, advice, "sampled")
    write_csv(episodes, folder / "episodes.csv")
    lines = {driver: result.lines for driver, result in drives.items()}
    crashed = {driver: [row["crashed"] for row in result.episodes] for driver, result in drives.items()}
    draw_lines(tracks, lines, folder / "lines.png", crashed=crashed)
    if config.evaluation.gif:
        rate = next(iter(drives.values())).rate
        animate_lines(tracks, lines, folder / "lines.gif", rate=rate, crashed=crashed)
    columns = {key: value for key, value in COLUMNS.items() if key != "advice" or config.evaluation.advice}
    tasks = {key: key.removeprefix(PER_STEP) for key in table[0] if key.startswith(PER_STEP)}
    columns |= {key: (f"{task} (a step)", ".3f") for key, task in tasks.items()}
    write_text(folder / "evaluation.md", markdown_table(table, columns))
    write_csv(table, folder / "evaluation.csv")


def _plan(config: DictConfig, agent: TensorDictModuleBase) -> list[tuple[str, int]]:
    """Return the kinds of advice, each with the number of sampled episodes a track."""
    plan = [("", config.evaluation.repeats if hasattr(agent, "get_dist") else 0)]
    if config.method.transforms:
        plan += [(advice, 0) for advice in config.evaluation.advice]
    return plan


def report_outcome(folder: Path) -> float:
    """Print the evaluation of a run, and return the mean reward of its deterministic agent, or else of its guide."""
    with file_of_a_run(path := folder / "evaluation.csv", "remove the file, and evaluate again"):
        with path.open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if (row["track"], row["actions"]) == ("mean", "deterministic")]
        last = [row for row in rows if not row["advice"]][-1]
        reward, completed = float(last["reward"]), float(last["completed"])
        page = (folder / "evaluation.md").read_text().rstrip()
    print(page)
    print(f"{last['driver']}: mean test reward {reward:.1f}, {completed:.0%} completed; see {folder}")
    return reward


def drive_guides(
    config: DictConfig,
    overrides: Mapping[str, Any],
    names: Sequence[str],
    guides: Mapping[str, TensorDictModuleBase] | None = None,
) -> dict[str, EvaluationResult]:
    """Evaluate each guide of a run alone, once on each of the tracks `names`; return the results by `driver_names`.

    `overrides` are of `env`. `guides` replace those of the configuration, whose results are cached.
    """
    if not guides:
        nodes = {key: OmegaConf.to_container(config[key], resolve=True) for key in ("guide", "degrade")}
        return dict(_drive_configured(OmegaConf.to_yaml({"env": env_node(config, overrides), **nodes}), tuple(names)))
    env, policy = build_guided_env(config, {**overrides, "num_cars": len(names)}, guides)
    with tqdm(unit="step", desc="guides", leave=False, mininterval=0.5) as bar:
        result = evaluate_policy(env, policy, names=names, tick=bar.update)
    return dict(zip(driver_names(guides), result.split(len(guides)), strict=True))


# The runs of a sweep share their guides.
@lru_cache(maxsize=64)
def _drive_configured(nodes: str, names: tuple[str, ...]) -> dict[str, EvaluationResult]:
    config: Any = OmegaConf.create(nodes)
    return drive_guides(config, {}, names, build_guides(config))


def driver_names(guides: Iterable[str]) -> list[str]:
    """Return the display names of guides: `guide` for a single one, otherwise `guide NAME`."""
    names = list(guides)
    return ["guide"] if len(names) == 1 else [f"guide {name}" for name in names]
