"""`coil-drive`: drive a car by its scans, on the simulated robot, on a recording, or with ROS 2."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from coil_rl.errors import UserError
from coil_rl.programs import app

if TYPE_CHECKING:
    from coil_rl.envs.recordings.reading import Recording
    from coil_rl.robot import DriveLog, LiveDriver
    from coil_rl.robot.sources import Drive


# Keys that have an effect everywhere, and in one of the places.
OF_ALL = ("where", "rate", "car", "perception", "spline", "smoothing", "limits")
OF_PLACES = {
    "simulation": ("simulation", "lift_after"),
    "recording": ("recording", "scan", "frame", "strict", "lift_after"),
    "ros": ("ros",),
}


def drive(config: DictConfig) -> None:
    """Drive, and write `drive.mcap` and `drive.md`."""
    import torch

    from coil_rl.files import write_text
    from coil_rl.robot.drive_log import DriveLog

    torch.set_num_threads(config.threads)
    folder = Path(config.run_dir)
    epoch = time.time() - time.monotonic() if config.where == "ros" else 0.0
    about = {"where": config.where, "run": str(config.run)}
    log = DriveLog(
        folder / "drive.mcap", epoch=epoch, max_steering=config.car.max_steering, about=about
    )
    driver, recording = make_driver(config, log), _recording(config)
    with log:
        result = _driven(config, driver, recording)
    if log.problem:
        print(f"drive: {log.problem}")
    if result is not None:
        text = "\n".join(described(result))
        write_text(folder / "drive.md", f"{text}\n")
        print(f"{text}\nsee {folder}")


def make_driver(config: DictConfig, log: DriveLog) -> LiveDriver:
    """Return the driver that a configuration describes.

    Raises:
        UserError: for a policy that cannot drive a car by the entries of the cone world.
    """
    from coil_rl.config.nodes import build
    from coil_rl.envs import Perception
    from coil_rl.robot.driver import Car, LiveDriver
    from coil_rl.robot.watchdog import Limits

    car = build(config.car, "car", Car)
    perception = build(config.perception, "perception", Perception)
    controller, rate = _controller(config, car)
    name = f"run={config.run}" if config.run is not None else "controller"
    try:
        limits = Limits(rate, **config.limits)
    except (TypeError, ValueError) as error:
        raise UserError(f"limits: {error}") from error
    try:
        return LiveDriver(
            controller,
            perception,
            limits,
            car,
            spline=config.spline,
            smoothing=config.smoothing,
            log=log,
        )
    except (AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise UserError(
            f"{name} cannot drive by what a robot observes ({error}); give a policy of "
            "env=cone_track or env=simulated_robot"
        ) from error


def _controller(config: DictConfig, car: Any) -> tuple[Any, float]:
    """Return what drives, and the scans per second for which it was trained."""
    from coil_rl.config.load import open_run
    from coil_rl.config.nodes import build

    if config.run is None:
        return build(config.controller, "controller"), config.rate
    controller = open_run(config.run, device=config.device).controller(config.policy)
    if config.rate is not None:
        return controller, config.rate
    plant: Any = controller.plant
    length, rate = getattr(plant, "car_length", None), getattr(plant, "rate", None)
    if not length or not rate:
        raise UserError(
            f"run={config.run} is of env {type(plant).__name__}, which has no car; give a run of "
            "env=cone_track or env=simulated_robot"
        )
    speed = getattr(plant, "speed", None) or plant.step_length * rate
    # The rate at which this car goes as far between two scans, in lengths of the car.
    return controller, rate * (car.speed / car.car_length) / (speed / length)


def _recording(config: DictConfig) -> Recording | None:
    """Return the recording to drive by, if there is one; a `UserError` if it cannot be read."""
    from coil_rl.envs.recordings.mcap_files import RecordingError
    from coil_rl.envs.recordings.reading import read_recording

    if config.recording is None:
        return None
    try:
        return read_recording(
            config.recording,
            scan=config.scan,
            odometry=None,
            command=None,
            frame=config.frame,
            strict=config.strict,
        )
    except RecordingError as error:
        raise UserError(f"recording: {error}") from error


def _driven(config: DictConfig, driver: LiveDriver, recording: Recording | None) -> Drive | None:
    """Drive where the configuration says; return the drive, None for a node of ROS 2."""
    from coil_rl.robot.sources import drive_recording, drive_simulation

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
        from coil_rl.robot.ros_node import run_node
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
    """Raise a `UserError` for the first mistake in the configuration.

    Otherwise make the folder of the results.
    """
    from coil_rl.config.check import make_folder
    from coil_rl.config.values import check_values

    check_values(config)
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
    app.check_used((*OF_ALL, *what, *OF_PLACES[config.where]), reason)
    make_folder(Path(config.run_dir))


main = partial(app.run_program, drive, "drive", check)

if __name__ == "__main__":
    main()
