"""`coil-listen`: which guide a trained agent listens to, and where on the track."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tqdm import tqdm

from coil_rl.errors import UserError
from coil_rl.files import write_text
from coil_rl.listening import Places, ablations, drive_ablated, split, survey
from coil_rl.listening.tables import EVERYWHERE, along, along_lines, by_place
from coil_rl.programs import app
from coil_rl.programs.evaluate import restore
from coil_rl.report import draw_listening_map, markdown_table, write_csv
from coil_rl.train.build import build, build_env
from coil_rl.train.check import check as check_common

COLUMNS = {
    "guide": ("guide", ""),
    "place": ("place", ""),
    "share": ("of the way", ".0%"),
    "agreement": ("|a - g|", ".3f"),
    "intervention": ("intervention", ".4f"),
    "gradient": ("gradient", ".3f"),
    "lost": ("return lost", ".1f"),
    "completed": ("completed", ".0%"),
}
NOTES = """
Means over the states of deterministic drives on the test tracks, in action units. intervention: how far the action
moves when the guide's advice is replaced by what it said elsewhere. return lost and completed: with this guide silent
there, saying always its mean. """
OF_NUMBERS = "gradient: |da/dg|."
OF_CHOICES = "The agent chooses: |a - g| and intervention are 0\nfor the same choice and 1.414 for any other."
MAPS = {
    "intervention": ("listening.png", "Where the agent listens", "action moved by other advice"),
    "agreement": ("listening_agreement.png", "Where the agent does otherwise", "|action - advice|"),
    "gradient": ("listening_gradient.png", "How the agent follows small changes of advice", "|da / dg|"),
}
LIMITS = {"donors": (1, 10_000), "turn_radius": (0.5, 1000.0), "approach": (0.1, 100.0), "bin": (0.1, 100.0)}


def listen(config: DictConfig) -> None:
    """Drive the run's agent, measure, and write the table, the numbers and the maps; `listening.csv` comes last."""
    torch.set_num_threads(config.threads)
    folder, asked = Path(config.run_dir), config
    config, agent = restore(Path(asked.run), asked)
    if agent is None:
        raise UserError(f"run={asked.run} has no agent: its guide drives alone; give a run that sees advice")
    try:
        split(agent)
    except ValueError as error:
        raise UserError(f"the agent of run={asked.run} has nobody to listen to: {error}") from error
    tracks = build(config.track.test, "track.test")
    places = Places(tracks, turn_radius=asked.turn_radius, approach=asked.approach, device=config.device)
    names = [track.name for track in tracks]
    cars = len(tracks) * config.evaluation.repeats
    folder.mkdir(parents=True, exist_ok=True)
    # Guides that draw from the global generator draw the same again.
    torch.manual_seed(asked.seed)
    with tqdm(unit="step", desc="listen", leave=False, mininterval=0.5) as bar:
        bar.set_postfix_str("all guides")
        env = build_env(config, {**config.evaluation.env, "num_cars": cars})
        found = survey(env, agent, places, donors=asked.donors, seed=asked.seed, names=names, tick=bar.update)
        removed = ablations(len(found.guides))
        bar.set_postfix_str("one guide less")
        env = build_env(config, {**config.evaluation.env, "num_cars": cars * len(removed)})
        silence = found.advice.mean(0)
        episodes = drive_ablated(env, agent, places, removed, silence, names=names, tick=bar.update)
    ablated = dict(zip(removed, episodes, strict=True))
    table = by_place(found, places, ablated)
    chooses = bool(found.measures["gradient"].isnan().all())
    columns = {key: column for key, column in COLUMNS.items() if not (chooses and key == "gradient")}
    notes = NOTES + (OF_CHOICES if chooses else OF_NUMBERS)
    write_text(folder / "listening.md", f"{markdown_table(table, columns)}\n{notes}")
    write_csv(table, folder / "listening_places.csv")
    for measure, (name, title, label) in MAPS.items():
        if measure not in columns:
            continue
        lines, values = along_lines(found, places, measure, asked.bin)
        draw_listening_map(tracks, lines, values, folder / name, label=label, title=title)
    write_csv(along(found, places, asked.bin), folder / "listening.csv")
    print((folder / "listening.md").read_text(encoding="utf-8"))
    print(f"{_outcome(config.label, table)}; see {folder}")


def _outcome(label: str, table: list[dict[str, Any]]) -> str:
    """Whom the agent listens to most, and where."""
    everywhere = {row["guide"]: row["intervention"] for row in table if row["place"] == EVERYWHERE}
    most = max(everywhere, key=lambda guide: everywhere[guide])
    somewhere = [row for row in table if row["guide"] == most and row["place"] != EVERYWHERE]
    where = max(somewhere, key=lambda row: row["intervention"])
    others = ", ".join(f"{guide} moves it by {moved:.4f}" for guide, moved in everywhere.items() if guide != most)
    return (
        f"{label} listens most to {most}, which moves its action by {everywhere[most]:.4f}, "
        f"most of all at {where['place']} ({where['intervention']:.4f}){f'; {others}' if others else ''}"
    )


def check(config: DictConfig) -> None:
    """Refuse a configuration with which nothing can be measured.

    Raises:
        UserError: in one sentence, what is wrong.
    """
    for key, (low, high) in LIMITS.items():
        if not low <= config[key] <= high:
            raise UserError(f"{key}={config[key]} must be between {low} and {high}")
    if not config.run:
        raise UserError("run must be the folder of a run: write run=FOLDER")
    check_common(config)


def main() -> None:
    """Entry point."""
    app.run(listen, "listen", check)


if __name__ == "__main__":
    main()
