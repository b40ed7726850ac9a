"""A live driver does what the closed loop does, and stops by its rules."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from drives import SplineDriver
from torchrl.envs import ExplorationType, set_exploration_type

from coil_rl import compose_train
from coil_rl.config.parts import build_learner, env_maker
from coil_rl.envs import Perception, SimulatedRobotEnv, simulated_cone_classifier
from coil_rl.envs.recordings.mcap_files import read_messages
from coil_rl.envs.recordings.reading import read_recording
from coil_rl.run.controller import Controller
from coil_rl.run.parts import TEST, TRAIN
from coil_robot import (
    Car,
    Command,
    DriveLog,
    Limits,
    LiveDriver,
    Scan,
    drive_recording,
    drive_simulation,
)

RATE = 5.5
FAULT = 20  # number of the scan from which something is wrong


class Guide(SplineDriver):
    """A guide that fails, or that acts in a way of its own, after some scans."""

    def __init__(self, fails_at=10**6, action=None):
        self.fails_at, self.action, self.scans = fails_at, action, 0

    def act(self, observation):
        self.scans += 1
        if self.scans <= self.fails_at:
            return super().act(observation)
        if self.action is None:
            raise RuntimeError("no weights")
        return self.action


def driver(controller=None, log=lambda moment: None, **limits):
    perception = Perception(simulated_cone_classifier())
    return LiveDriver(controller or Guide(), perception, Limits(RATE, **limits), log=log)


def driven(live, seconds=9.0, **options):
    """Return the drive of a driver on the simulated robot, and the way that the robot went."""
    env = SimulatedRobotEnv(assignment="cyclic", time_limit=60, seed=3)
    result = drive_simulation(live, env, seconds, **options)
    return result, env


POLICIES = {
    "guide": ["method=guide"],
    "coil": ["method=coil_anchored"],
    "residual": ["method=residual", "learner.action_gain=1"],
    "ppo": ["method=ppo", "learner.action_gain=1"],
    "gru": ["method=residual", "network=gru", "learner.action_gain=1"],
}


def untrained(words):
    """Return an env, the policy of an untrained run, and its controller."""
    config = compose_train(["env=simulated_robot", *words, "run_dir=unused"])
    make_env = env_maker(config)
    torch.manual_seed(0)
    if config.method.observes is None:
        return *make_env.guided(1, TEST), Controller(*make_env.guided(1, TRAIN))
    env, own = make_env(1, TEST), make_env(1, TRAIN)
    policy = build_learner(config, own).policy
    return env, policy, Controller(own, policy)


@pytest.mark.fast("coil")
@pytest.mark.parametrize("name", POLICIES)
def test_commands_are_those_of_the_closed_loop(name):
    env, policy, controller = untrained(POLICIES[name])
    # The policies are untrained: without its rules the driver goes on where they leave the track.
    live = driver(controller, fewest_returns=0.0, blind=1e6, still=0.0)
    base, state = env.base_env, env.eval().reset()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for index in range(60):
            scan = Scan(index / RATE, base.scan[0].numpy().copy(), base.lidar.angles.numpy())
            command = live.scan(scan, (index + 1) / RATE)
            step = env.step(policy(state))
            expected = Car().command(float(step["next", "steering"]))
            assert live.state == "driving", live.reason
            assert abs(command.turn_rate - expected.turn_rate) <= 1e-6
            state = env.step_mdp(step)


# Changes of scans and of what the car does, as options of `drive_simulation`.


def changed(**values):
    """Return a change of the fields of a scan, each a function of its number and the scan."""

    def change(index, scan, now):
        if index >= FAULT:
            scan = replace(scan, **{key: make(index, scan) for key, make in values.items()})
        return scan, now

    return {"change": change}


def lost(index, scan, now):
    return None if index >= FAULT else scan, now


def late_clock(index, scan, now):
    return scan, now - 100.0 if index >= FAULT else now


def half_rate(index, scan, now):
    return (None if index >= FAULT and index % 2 else scan), now


def double_rate(index, scan, now):
    early = max(0, index - FAULT) / RATE / 2
    return replace(scan, stamp=scan.stamp - early), now - early


def queued(index, scan, now):
    return scan, now + 0.15 * max(0, index - FAULT) / RATE


class Frozen:
    """Scans of which one repeats."""

    def __call__(self, index, scan, now):
        if index == FAULT:
            self.ranges = scan.ranges
        return (replace(scan, ranges=self.ranges) if index > FAULT else scan), now


def moved(speed=1.0, pull=0.0):
    """Return a change of what the car does: a factor of its speed, and a turn rate more."""

    def follow(index, command):
        if index < FAULT:
            return command
        return Command(speed * command.speed, speed * command.turn_rate + pull)

    return {"follow": follow}


NAN = float("nan")
EMPTY = np.zeros(0)
NO_RETURN = np.full(360, np.inf, np.float32)
MIRRORED = changed(ranges=lambda n, scan: np.roll(scan.ranges[::-1], -1))
TURNED = changed(ranges=lambda n, scan: np.roll(scan.ranges, 180))
COVERED = changed(ranges=lambda n, scan: (0.3 + 0.001 * (n % 7)) * np.ones(360, np.float32))
HALF = {"ranges": lambda n, scan: scan.ranges[:180], "angles": lambda n, scan: scan.angles[:180]}
STUCK_WITHOUT_ODOMETRY = moved(speed=0.0) | {"odometry": False}
# What is wrong, the reason of the stop, and the seconds within which the car stops.
FAULTS = {
    "no more scans": ({"change": lost}, "gap of 0.5", 0.6),
    "stamp is NaN": (changed(stamp=lambda *_: NAN), "stamp that is not finite", 0.2),
    "stamp stands": (changed(stamp=lambda *_: (FAULT - 1) / RATE), "does not rise", 0.2),
    "stamp jumps back": (changed(stamp=lambda n, scan: scan.stamp - 10), "does not rise", 0.2),
    "stamp jumps ahead": (changed(stamp=lambda n, scan: scan.stamp + 3600), "gap of 3600.", 0.2),
    "no returns": (changed(ranges=lambda *_: NO_RETURN), "0.0% of its beams have a return", 0.2),
    "ranges are NaN": (changed(ranges=lambda *_: NAN * NO_RETURN), "0.0% of its beams", 0.2),
    "empty scan": (changed(ranges=lambda *_: EMPTY, angles=lambda *_: EMPTY), "no ranges", 0.2),
    "half of the beams": (changed(**HALF), "invalid scan: 180 beams instead of 360", 0.2),
    "angles are NaN": (changed(angles=lambda n, scan: NAN * scan.angles), "are not finite", 0.2),
    "frozen scanner": ({"change": Frozen()}, "repeats the one before to the last digit", 0.4),
    "covered scanner": (COVERED, "no view of both boundaries for 2.", 2.6),
    "mirrored scans": (MIRRORED, "left cones right of the right ones in 4 of the last 6", 0.8),
    "turned scans": (TURNED, "left cones right of the right ones in 4 of the last 6", 0.8),
    "queue that grows": ({"change": queued}, "come late: 0.38 s later than the quickest", 3.0),
    "half the rate": ({"change": half_rate}, "rate: scans arrive 3.7 times", 2.0),
    "twice the rate": ({"change": double_rate}, "rate: scans arrive 7.3 times", 1.0),
    "clock goes back": ({"change": late_clock}, "steady clock that goes back", 0.2),
    "stuck car": (moved(speed=0.0), "does not follow: its speed is off by -0.08 m/s", 2.0),
    "stuck car without odometry": (STUCK_WITHOUT_ODOMETRY, "the scans stand still for 1.6 s", 2.4),
    "slow car": (moved(speed=0.3), "does not follow: its speed is off by -0.", 2.0),
    "car that pulls to the left": (moved(pull=0.45), "its turn rate is off by +0.", 2.0),
    "policy fails": ({"controller": Guide(FAULT + 1)}, "policy that fails: no weights", 0.2),
    "NaN as action": (
        {"controller": Guide(FAULT + 1, np.array([NAN]))},
        "policy whose action is not finite",
        0.2,
    ),
}


@pytest.mark.fast("no more scans", "covered scanner", "policy fails", "NaN as action")
@pytest.mark.parametrize("name", FAULTS)
def test_faults_stop_the_car_until_the_stop_is_lifted(name):
    options, reason, within = FAULTS[name]
    moments = []
    live = driver(options.get("controller"), log=moments.append)
    result, _ = driven(live, **{key: options[key] for key in options if key != "controller"})
    (stop,) = result.stops
    assert reason in stop[1]
    begin = (FAULT + 1) / RATE
    assert name == "clock goes back" or 0 <= stop[0] - begin <= within
    assert live.state == "stopped"
    assert live.command == (0.0, 0.0)
    states = [moment.state for moment in moments]
    first = states.index("stopped")
    assert all(moment.command == (0.0, 0.0) for moment in moments[first:])
    assert set(states[:first]) == {"driving"}
    live.lift(100.0)
    assert (live.state, live.command) == ("waiting", (0.0, 0.0))


@pytest.mark.slow
def test_a_healthy_robot_drives_and_survives_a_single_lost_scan():
    def one_lost(index, scan, now):
        return (None if index == FAULT else scan), now

    for change in (None, one_lost):
        result, env = driven(driver(), 9.0, change=change)
        assert not result.stops
        assert result.states["driving"] == result.scans
        assert not env.lap_start.isnan().any()


HALF_BLIND = changed(ranges=lambda n, scan: np.where(np.arange(360) < 180, np.inf, scan.ranges))


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (HALF_BLIND, "no view of both boundaries yet"),
        (MIRRORED, "mirrored or turned"),
        (TURNED, "mirrored or turned"),
    ],
)
def test_the_car_does_not_move_by_what_is_wrong_from_the_start(fault, reason):
    def from_the_start(index, scan, now):
        return fault["change"](index + FAULT, scan, now)

    live = driver()
    result, env = driven(live, 3.0, change=from_the_start)
    assert result.states == {"waiting": result.scans}
    assert reason in live.reason
    assert torch.equal(env.pose, env.start_pose[:, :1])


@pytest.mark.slow
def test_a_lifted_stop_needs_a_valid_scan_before_the_car_moves():
    def gap(index, scan, now):
        return (None if FAULT <= index < FAULT + 5 else scan), now

    moments = []
    live = driver(log=moments.append)
    result, _ = driven(live, 12.0, change=gap, lift_after=1.0)
    assert len(result.stops) == 1
    states = [moment.state for moment in moments]
    assert list(dict.fromkeys(states)) == ["driving", "stopped", "waiting"]
    assert live.state == "driving"


def test_odometry_that_ends_stops_the_car():
    live = driver()
    driven(live, 3.0)
    now = 3.0 + 2 / RATE
    live.odometry(*live.command, now)
    assert live.command.speed > 0
    live.watchdog.arrivals.append(now + 1.6)
    assert live.tick(now + 1.6) == (0.0, 0.0)
    assert live.reason == "no odometry for 1.6 s"


def test_the_log_holds_what_the_driver_saw_and_did_and_can_be_driven_by_again(tmp_path):
    path = tmp_path / "drive.mcap"
    with DriveLog(path, about={"run": "guide"}) as log:
        result, _ = driven(driver(log=log), change=lost)
    contents = read_messages(path)
    assert contents.notes["coil"] == {"run": "guide"}
    assert len(contents.messages["/scan"]) == result.scans == FAULT
    assert len(contents.messages["/coil/steering"]) == FAULT
    recording = read_recording(path)
    assert recording.commands[0][-1].tolist() == [0.0, 0.0]
    assert recording.commands[0][0, 0] == 0.15
    again = drive_recording(driver(), recording)
    assert again.states == {"driving": FAULT}
    assert b"stopped: gap of" in contents.messages["/coil/state"][-1].data
    assert not list(tmp_path.glob(".*"))


def test_a_full_disk_ends_the_log_and_not_the_drive(tmp_path, monkeypatch):
    with DriveLog(tmp_path / "drive.mcap") as log:

        def full(*_):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(log._writer, "add_message", full)
        result, _ = driven(driver(log=log), 3.0)
    assert not result.stops
    assert "No space left on device" in log.problem


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Limits(0), "rate=0 must be"),
        (lambda: Limits(5.5, longest_gap=0.1), "longest_gap=0.1 s must be more than the time"),
        (lambda: Car(speed=-1), "speed=-1 must be"),
        (lambda: driver(Guide(0, np.zeros(2))), "acts with 2 numbers; a car needs one"),
    ],
)
def test_what_cannot_drive_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_turn_rate_is_limited_where_the_car_says_so():
    assert Car(largest_turn_rate=0.2).command(-1.0).turn_rate == -0.2
    assert abs(Car().command(1.0).turn_rate - 0.15 * math.sin(math.radians(80)) * 3.5) < 1e-6


def test_files_are_not_left_behind(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), DriveLog(tmp_path / "drive.mcap"):
        raise RuntimeError("anything")
    assert [file.name for file in tmp_path.iterdir()] == ["drive.mcap"]


def test_range_of_0_is_no_return():
    """Many scanners send 0 for it, and some of them say that their smallest range is 0."""
    ranges = np.array([0.0, 0.4, 13.0, np.inf], np.float32)
    returns = Scan(0.0, ranges, np.zeros(4), range_min=0.0).returns()
    assert returns.tolist() == [np.inf, pytest.approx(0.4), np.inf, np.inf]
