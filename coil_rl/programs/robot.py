"""`coil-robot`: the simulated robot, from labelling drives and the cone classifier to Tables 6 and 7."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig, open_dict

from coil_rl.errors import UserError
from coil_rl.programs import app

if TYPE_CHECKING:
    from coil_rl.robot.drivers import Driver

# Steps in order, and the output of each.
STEPS = {"record": "labelling", "train": "figure_25.md", "drive": "drives", "table": "table_6.md"}


def robot(config: DictConfig) -> None:
    """Run the chosen steps; write and print the pages."""
    import torch
    from tqdm import tqdm

    from coil_rl.envs.robot.drives import record_labelling_drives
    from coil_rl.robot.drivers import record
    from coil_rl.train.evaluate_run import build_evaluation

    torch.set_num_threads(config.threads)
    folder = Path(config.run_dir)
    if "record" in config.steps:
        pairs, tests = config.figure_25.pairs, config.figure_25.tests
        with tqdm(total=2 * pairs + tests, desc="record", unit="drive", leave=False) as bar:
            config.figure_25.update(record_labelling_drives(folder / STEPS["record"], pairs, tests, bar.update))
    if "train" in config.steps:
        _make_page(config, "figure_25", folder)
    if "drive" in config.steps:
        if "train" in config.steps:
            with open_dict(config):
                loader = "coil_rl.robot.classifier.load_classifier"
                config.env.perception.classifier = {"_target_": loader, "path": str(folder / "cones.json")}
        robots = config.evaluation.repeats * len(build_evaluation(config).cases)
        record(_drivers(config, robots), folder / STEPS["drive"], robots)
    if "table" in config.steps:
        config.recordings = config.recordings or [str(folder / STEPS["drive"])]
        _make_page(config, "table_6", folder)
    print(f"robot: {', '.join(step for step in STEPS if step in config.steps)} done; see {folder}")


def _make_page(config: DictConfig, name: str, folder: Path) -> None:
    from coil_rl.files import write_text
    from coil_rl.reproduce import Result
    from coil_rl.train.build import build

    text = build(config[name], name, Result).make(folder / name)
    write_text(folder / f"{name}.md", text)
    print(f"{text}\n")


def _drivers(config: DictConfig, robots: int) -> Iterator[Driver]:
    """Yield every guide and the agent of every run, with numbered names."""
    from coil_rl.robot.drivers import Driver, agent_driver
    from coil_rl.train.build import build_bare_env, build_guided_env, build_guides
    from coil_rl.train.evaluate_run import driver_names
    from coil_rl.train.run_folder import read_config

    overrides = {**config.evaluation.env, "num_envs": robots}
    guides = build_guides(config)
    for number, (display_name, (key, guide)) in enumerate(zip(driver_names(guides), guides.items(), strict=True)):
        name = f"{number:02d}_{display_name}".replace(" ", "_")
        yield Driver(name, {"policy": display_name}, partial(build_guided_env, config, overrides, {key: guide}))
    for number, run in enumerate(map(Path, config.runs), start=len(guides)):
        run_config = read_config(run, "runs", {"device": config.device})
        name = f"{number:02d}_{run_config.label}_seed{run_config.seed}".replace(" ", "_")
        make_robots = partial(build_bare_env, config, overrides)
        yield agent_driver(run, run_config, make_robots, config.evaluation.policy, name)


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration."""
    from coil_rl.envs import SimulatedRobotEnv
    from coil_rl.reproduce import Result
    from coil_rl.train.build import build
    from coil_rl.train.check import check as check_common
    from coil_rl.train.evaluate_run import build_evaluation

    used = ("preset", "track", "env", "guide", "degrade", "evaluation")
    own = ("steps", "runs", "recordings", "table_6", "figure_25")
    app.check_used((*used, *own), "guides drive alone, and each of the runs has its own configuration")
    unknown = [step for step in config.steps if step not in STEPS]
    if unknown or not config.steps:
        raise UserError(f"steps={list(config.steps)} must be some of {', '.join(STEPS)}")
    folder = Path(config.run_dir)
    for step in config.steps:
        if (folder / STEPS[step]).exists():
            raise UserError(f"{folder} already holds {STEPS[step]}; choose another folder with hydra.run.dir=FOLDER")
    drivers = _drivers(config, len(build_evaluation(config).cases)) if "drive" in config.steps else ()
    for driver in drivers:
        env, _ = driver.make_env_and_policy()
        if not isinstance(env.base_env, SimulatedRobotEnv):
            kind = type(env.base_env).__name__
            raise UserError(f"{driver.about['policy']} drives a {kind}; give env=simulated_robot")
    if "table" in config.steps and config.recordings:
        build(config.table_6, "table_6", Result)
    elif "table" in config.steps and "drive" not in config.steps and not (folder / STEPS["drive"]).is_dir():
        raise UserError("recordings is empty and there is no drive; give recordings=[FILE,...] or add the step drive")
    if "train" in config.steps and "record" not in config.steps:
        build(config.figure_25, "figure_25", Result)
    check_common(config)


def main() -> None:
    """Entry point."""
    app.run(robot, "robot", check)


if __name__ == "__main__":
    main()
