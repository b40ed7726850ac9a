"""`coil-drive`: drive a car by its scans, on the simulated robot, on a recording, or with ROS 2."""

from __future__ import annotations

import time
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

import coil_robot.schema  # noqa: F401  registers the root configurations with Hydra
from coil_rl import UserError, run_program

if TYPE_CHECKING:
    from coil_rl.envs import Recording
    from coil_robot import DriveLog, LiveDriver, Setup
    from coil_robot.sources import Drive


# Keys that have an effect everywhere, and in one of the places.
OF_ALL = ("where", "rate", "car", "perception", "spline", "smoothing", "limits")
OF_PLACES = {
    "simulation": ("simulation", "lift_after"),
    "recording": ("recording", "scan", "frame", "strict", "lift_after"),
    "ros": ("ros",),
}


def drive(config: DictConfig) -> None:
    """Drive, and write `drive.mcap` and `drive.md`."""
    from coil_rl import write_text
    from coil_robot.drive_log import DriveLog

    folder = Path(config.run_dir)
    epoch = time.time() - time.monotonic() if config.where == "ros" else 0.0
    about = {"where": config.where, "run": str(config.run)}
    controller, setup = _controller(config)
    log = DriveLog(
        folder / "drive.mcap", epoch=epoch, max_steering=setup.car.max_steering, about=about
    )
    driver, recording = _driver(config, controller, setup, log), _recording(config)
    with log:
        result = _driven(config, driver, recording)
    if log.problem:
        print(f"drive: {log.problem}")
    if result is not None:
        text = "\n".join(described(result))
        write_text(folder / "drive.md", f"{text}\n")
        print(f"{text}\nsee {folder}")


def _controller(config: DictConfig) -> tuple[Any, Setup]:
    """Return what drives, and what it drives with: as in its training where nothing is given."""
    from coil_rl import build, open_run
    from coil_rl.for_guests import say
    from coil_robot.setup import Setup, setup_of

    if config.run is None:
        return build(config.controller, "controller"), _setup(config, Setup())
    controller = open_run(config.run, device=config.device).controller(config.policy)
    trained = setup_of(controller.plant)
    setup = _setup(config, trained)
    differences = setup.differences(trained)
    if differences:
        say(f"drive: {', '.join(differences)}, with which the policy was trained", error=True)
    return controller, setup


def _setup(config: DictConfig, trained: Setup) -> Setup:
    """Return a setup with what the configuration gives."""
    car = _changed(trained.car, config.car, "car")
    setup = trained.for_car(car)
    given = {key: config[key] for key in ("spline", "smoothing", "rate") if config[key] is not None}
    perception = _changed(setup.perception, config.perception, "perception")
    return replace(setup, perception=perception, **given)


def _changed(part: Any, node: Any, name: str) -> Any:
    """Return a dataclass with the values that a node gives, which are those that are not null."""
    from coil_rl import build
    from coil_rl.for_guests import check_arguments

    values: Any = OmegaConf.to_container(node, resolve=True)
    values = {key: each for key, each in values.items() if each not in (None, {"_target_": None})}
    others = [each.name for each in fields(part) if each.name not in values]
    check_arguments(type(part), values, name, others)
    for key, value in values.items():
        if isinstance(value, dict):
            values[key] = build(value, f"{name}.{key}")
    try:
        return replace(part, **values)
    except (TypeError, ValueError) as error:
        raise UserError(f"{name}: {error}") from error


def _driver(config: DictConfig, controller: Any, setup: Setup, log: DriveLog) -> LiveDriver:
    """Return the driver.

    Raises:
        UserError: for a policy that cannot drive a car by the entries of the cone world.
    """
    from coil_rl import build
    from coil_robot.driver import LiveDriver

    if setup.rate is None:
        raise UserError(
            f"run={config.run} is of env {type(controller.plant).__name__}, which has no rate of "
            "scans; give a run of env=cone_track or env=simulated_robot, or rate=NUMBER"
        )
    node = {"_target_": "coil_robot.Limits", "rate": setup.rate, **config.limits}
    limits = build(node, "limits")
    try:
        return LiveDriver(
            controller,
            setup.perception,
            limits,
            setup.car,
            spline=setup.spline,
            smoothing=setup.smoothing,
            log=log,
        )
    except (AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
        name = f"run={config.run}" if config.run is not None else "controller"
        raise UserError(
            f"{name} cannot drive by what a robot observes ({error}); give a policy of "
            "env=cone_track or env=simulated_robot"
        ) from error


def _recording(config: DictConfig) -> Recording | None:
    """Return the recording to drive by, if there is one; a `UserError` if it cannot be read."""
    from coil_rl import build

    if config.recording is None:
        return None
    node = {
        "_target_": "coil_rl.envs.read_recording",
        "path": config.recording,
        "scan": config.scan,
        "odometry": None,
        "command": None,
        "frame": config.frame,
        "strict": config.strict,
    }
    recording: Recording = build(node, "recording")
    return recording


def _driven(config: DictConfig, driver: LiveDriver, recording: Recording | None) -> Drive | None:
    """Drive where the configuration says; return the drive, None for a node of ROS 2."""
    from coil_robot.sources import drive_recording, drive_simulation

    if recording is not None:
        return drive_recording(driver, recording, config.lift_after)
    if config.where == "simulation":
        from coil_rl.envs import SimulatedRobotEnv

        env = SimulatedRobotEnv(
            num_envs=1,
            assignment="cyclic",
            laps=config.simulation.laps,
            time_limit=config.simulation.seconds,
            speed=driver.car.speed,
            car_length=driver.car.car_length,
            max_steering=driver.car.max_steering,
            seed=config.seed,
        )
        return drive_simulation(
            driver, env, config.simulation.seconds, lift_after=config.lift_after
        )
    try:
        from coil_robot.ros_node import run_node
    except ImportError as error:
        raise UserError(
            f"where=ros needs ROS 2 ({error}); run it where ROS 2 is installed, after: source "
            "/opt/ros/DISTRO/setup.bash"
        ) from error
    options: Any = OmegaConf.to_container(config.ros, resolve=True)
    run_node(driver, **options)
    return None


def described(result: Drive) -> list[str]:
    """Return the lines of a report on a drive."""
    import numpy as np

    states = ", ".join(f"{state} {count}" for state, count in sorted(result.states.items()))
    laps = "" if result.laps is None else f"; {result.laps} laps"
    lines = [f"{result.scans} scans ({states}); {result.ended}{laps}."]
    for reason, count in result.waits.most_common(3):
        lines.append(f"Waited after {count} scans: {reason}.")
    lines += [f"Stopped at {now:.2f} s: {reason}." for now, reason in result.stops]
    if result.milliseconds:
        median, most = np.percentile(result.milliseconds, [50, 95])
        lines.append(f"CPU time of a scan: median {median:.1f} ms, 95th percentile {most:.1f} ms.")
    return lines


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration."""
    from coil_rl.for_guests import check_used

    if (config.run is None) == (not config.controller):
        raise UserError(
            "give what drives: run=FOLDER, or +controller._target_=PACKAGE.NAME; and not both"
        )
    if config.controller and config.rate is None:
        raise UserError(
            "rate is missing: give the scans per second for which the controller was made, as in "
            "rate=5.5"
        )
    if (config.where == "recording") != (config.recording is not None):
        raise UserError(
            f"where={config.where} recording={config.recording} do not go together: give "
            "where=recording recording=FILE, or neither"
        )
    what = ("controller",) if config.run is None else ("run", "policy")
    reason = f"nothing reads it with a {what[0]} and where={config.where}"
    check_used((*OF_ALL, *what, *OF_PLACES[config.where]), reason)


main = partial(run_program, drive, "drive", check, "pkg://coil_robot.conf")

if __name__ == "__main__":
    main()
