"""`coil-robot`: the simulated robot, from labelling drives and the cone classifier to Tables 6 and 7."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch
from omegaconf import DictConfig, open_dict
from tqdm import tqdm

from coil_rl.envs import SimulatedRobotEnv
from coil_rl.envs.robot.simulated_recordings import record_labelling_drives
from coil_rl.errors import UserError
from coil_rl.files import write_text
from coil_rl.programs import app
from coil_rl.reproduce import Result
from coil_rl.robot.drives import Driver, agent_of, record
from coil_rl.train.build import build, build_bare_env, build_guided_env, build_guides
from coil_rl.train.check import check as check_common
from coil_rl.train.evaluate_run import driver_names
from coil_rl.train.load import read_config

# From each step, in the order in which they build on each other, to what it leaves.
STEPS = {"record": "labelling", "train": "figure_25.md", "drive": "drives", "table": "table_6.md"}


def robot(config: DictConfig) -> None:
    """Do the steps that were asked for; print the pages and leave them in the folder."""
    torch.set_num_threads(config.threads)
    folder = Path(config.run_dir)
    if "record" in config.steps:
        _record(config, folder / STEPS["record"])
    if "train" in config.steps:
        _make(config, "figure_25", folder)
    if "drive" in config.steps:
        if "train" in config.steps:
            _see_with(config, folder / "cones.skops")
        _drive(config, folder / STEPS["drive"])
    if "table" in config.steps:
        config.recordings = config.recordings or [str(folder / STEPS["drive"])]
        _make(config, "table_6", folder)
    print(f"robot: {', '.join(step for step in STEPS if step in config.steps)} done; see {folder}")


def _record(config: DictConfig, folder: Path) -> None:
    """Simulate labelling drives, of which the classifier will learn."""
    pairs, tests = config.figure_25.pairs, config.figure_25.tests
    with tqdm(total=2 * pairs + tests, desc="record", unit="drive", leave=False) as bar:
        config.figure_25.update(record_labelling_drives(folder, pairs, tests, bar.update))


def _see_with(config: DictConfig, classifier: Path) -> None:
    """Let the robots see with the classifier in a file."""
    with open_dict(config):
        target = {"_target_": "coil_rl.robot.load_classifier", "path": str(classifier)}
        config.env.perception.classifier = target


def _drive(config: DictConfig, folder: Path) -> None:
    """Let every guide and the agent of every run drive, and record it."""
    robots = config.evaluation.repeats * _tracks(config)
    record(_drivers(config, robots), folder, robots)


def _tracks(config: DictConfig) -> int:
    return len(build(config.track.test, "track.test"))


def _drivers(config: DictConfig, robots: int) -> Iterator[Driver]:
    """Every guide and the agent of every run, each for so many robots, with names in their order."""
    overrides = {**config.evaluation.env, "num_cars": robots}
    guides = build_guides(config)
    for number, (called, (name, guide)) in enumerate(zip(driver_names(guides), guides.items(), strict=True)):
        seated = partial(build_guided_env, config, overrides, {name: guide})
        yield Driver(f"{number:02d}_{called}".replace(" ", "_"), {"policy": called}, seated)
    for number, run in enumerate(map(Path, config.runs), start=len(guides)):
        of_run = read_config(run, "runs", {"device": config.device})
        name = f"{number:02d}_{of_run.label}_seed{of_run.seed}".replace(" ", "_")
        bare = partial(build_bare_env, config, overrides)
        yield agent_of(run, of_run, bare, config.evaluation.policy, name)


def _make(config: DictConfig, name: str, folder: Path) -> None:
    text = build(config[name], name, Result).make(folder / name)
    write_text(folder / f"{name}.md", text)
    print(f"{text}\n")


def check(config: DictConfig) -> None:
    """Refuse a configuration that could not be gone through to its end.

    Raises:
        UserError: in one sentence, what is wrong.
    """
    unknown = [step for step in config.steps if step not in STEPS]
    if unknown or not config.steps:
        raise UserError(f"steps={list(config.steps)} must be some of {', '.join(STEPS)}")
    folder = Path(config.run_dir)
    for step in config.steps:
        if (folder / STEPS[step]).exists():
            raise UserError(f"{folder} already holds {STEPS[step]}; choose another folder with hydra.run.dir=FOLDER")
    if "drive" in config.steps:
        _check_drivers(config)
    if "table" in config.steps:
        _check_recordings(config, folder)
    if "train" in config.steps and "record" not in config.steps:
        build(config.figure_25, "figure_25", Result)
    check_common(config)


def _check_recordings(config: DictConfig, folder: Path) -> None:
    if config.recordings:
        build(config.table_6, "table_6", Result)
    elif "drive" not in config.steps and not (folder / STEPS["drive"]).is_dir():
        raise UserError("recordings is empty and nothing is driven; give recordings=[FILE,...] or add the step drive")


def _check_drivers(config: DictConfig) -> None:
    for driver in _drivers(config, _tracks(config)):
        env, _ = driver.seated()
        if not isinstance(env.base_env, SimulatedRobotEnv):
            kind = type(env.base_env).__name__
            raise UserError(f"{driver.about['policy']} drives a {kind}; give env=simulated_robot")


def main() -> None:
    """Entry point."""
    app.run(robot, "robot", check)


if __name__ == "__main__":
    main()
