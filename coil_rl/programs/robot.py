"""`coil-robot`: the simulated robot, from labelling drives and the cone classifier to Tables 6 and 7."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from omegaconf import DictConfig, open_dict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from tqdm import tqdm

from coil_rl.build import build, build_bare_env, build_guided_env, build_guides
from coil_rl.check import check as check_common
from coil_rl.envs import SimulatedRobotEnv, record_drives
from coil_rl.envs.simulated_recordings import record_labelling_drives
from coil_rl.errors import UserError
from coil_rl.files import whole_file
from coil_rl.programs import app
from coil_rl.reproduce import Result
from coil_rl.trained import configuration, in_env

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
        target = {"_target_": "coil_rl.perception.load_classifier", "path": str(classifier)}
        config.env.perception.classifier = target


def _drive(config: DictConfig, folder: Path) -> None:
    """Let every guide and the agent of every run drive, and record it."""
    with tqdm(desc="drive", unit="step", leave=False, mininterval=0.5) as bar:
        for number, (about, env, policy) in enumerate(_drivers(config)):
            seed = f"_seed{about['seed']}" if "seed" in about else ""
            name = f"{number:02d}_{about['policy']}{seed}".replace(" ", "_")
            bar.set_postfix_str(name)
            paths = [folder / f"{name}_{robot}.mcap" for robot in range(env.batch_size[0])]
            record_drives(env, policy, paths, about, bar.update)


def _drivers(
    config: DictConfig, repeats: int | None = None
) -> Iterator[tuple[dict[str, str], EnvBase, TensorDictModuleBase]]:
    """What is to be noted about each driver, the robots it drives, and its policy."""
    robots = (repeats or config.evaluation.repeats) * len(build(config.track.test, "track.test"))
    overrides = {**config.evaluation.env, "num_cars": robots}
    guides = build_guides(config)
    for name, guide in guides.items():
        called = "guide" if len(guides) == 1 else f"guide {name}"
        yield {"policy": called}, *build_guided_env(config, overrides, {name: guide})
    for run in map(Path, config.runs):
        of_run = configuration(run, "runs", {"device": config.device})
        env, policy = in_env(run, of_run, build_bare_env(config, overrides), config.evaluation.policy)
        yield {"policy": of_run.label, "seed": str(of_run.seed), "run": run.name}, env, policy


def _make(config: DictConfig, name: str, folder: Path) -> None:
    text = build(config[name], name, Result).make(folder / name)
    with whole_file(folder / f"{name}.md") as unfinished:
        unfinished.write_text(text + "\n", encoding="utf-8")
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
    for about, env, _ in _drivers(config, repeats=1):
        if not isinstance(env.base_env, SimulatedRobotEnv):
            raise UserError(f"{about['policy']} drives a {type(env.base_env).__name__}; give env=simulated_robot")


def main() -> None:
    """Entry point."""
    app.run(robot, "robot", check)


if __name__ == "__main__":
    main()
