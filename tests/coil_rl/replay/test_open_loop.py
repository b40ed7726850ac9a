"""What policies would have steered, scan by scan, and what the robot was told instead."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from drives import drive
from tensordict.nn import TensorDictModule

from coil_rl.envs import (
    McapReplayEnv,
    Perception,
    Recording,
    SimulatedRobotEnv,
    record_drives,
    simulated_cone_classifier,
)
from coil_rl.guides import ConstantGuide, SplineGuide
from coil_rl.replay import RECORDED, open_loop

TURN_RATE, LARGEST = 0.15 / (2 / 7), math.radians(80)


def blind(ranges, angles):
    """Perception that sees no cone."""
    return np.zeros((len(ranges), 2, 16, 2)), np.zeros((len(ranges), 2))


def told(omegas=(), since=(), scans=4):
    """A recording of scans at 0, 100, 200 ... ns with commands at other times, if any."""
    times, ones = np.arange(scans) * 100, np.ones(scans)
    commands = np.stack([np.full(len(omegas), 0.15), omegas], axis=1), np.array(since)
    return Recording(
        Path("drive"), False, times, times, np.ones((scans, 9), np.float32), ones.astype(int) * 9, -ones, ones / 9,
        commands=commands if len(omegas) else None,
    )  # fmt: skip


def asked(recordings, *guides, **options):
    replay = McapReplayEnv(recordings, blind)
    return open_loop(replay, {str(n): (replay, guide) for n, guide in enumerate(guides)}, **options)


def test_the_policy_that_drove_says_again_what_was_recorded(tmp_path):
    path = tmp_path / "drive.mcap"
    record_drives(SimulatedRobotEnv(time_limit=25 / 5.5, seed=4), SplineGuide(), [path])
    replay = McapReplayEnv(path, Perception(simulated_cone_classifier()))
    [found] = open_loop(replay, {"driver": (replay, SplineGuide())})
    driver, recorded = found.steering["driver"], found.steering[RECORDED]
    assert np.abs(driver.omega).max() > 0.1
    for one, other in zip(vars(driver).values(), vars(recorded).values(), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-3)
    assert found.policies == ["driver"]


def test_smoothness_and_omega_are_those_of_the_simulation():
    [found] = asked(told(), ConstantGuide(0.5))
    steering = found.steering["0"]
    assert steering.action.tolist() == [0.5] * 4
    np.testing.assert_allclose(steering.omega, TURN_RATE * math.sin(LARGEST / 2), rtol=1e-6)
    weights = np.exp(-0.1 * np.arange(20))
    expected = [0.5 - 0.5 * weights[:before].sum() / weights.sum() for before in range(4)]
    np.testing.assert_allclose(steering.smoothness, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("since", "expected"),
    [
        ([0, 100, 200, 300], [0.1, 0.2, 0.3, 0.4]),  # told together with the scan
        ([30, 130, 230, 330], [0.1, 0.2, 0.3, 0.4]),  # a little later
        ([30, 60, 230, 250], [0.1, 0.2, 0.3, 0.4]),  # the first after a scan; without one the last still holds
        ([110, 120, 130, 140], [math.nan, 0.1, 0.4, 0.4]),  # before the first one nothing is known
        ([-90, -80, -70, -60], [0.4, 0.4, 0.4, 0.4]),
    ],
)
def test_command_of_a_scan_is_the_first_one_that_may_answer_it(since, expected):
    [found] = asked(told([0.1, 0.2, 0.3, 0.4], since), ConstantGuide(0.0))
    np.testing.assert_array_equal(found.steering[RECORDED].omega, expected)


def test_recorded_command_becomes_the_action_that_turns_as_fast_or_the_largest():
    action = [0.25, -1.0, 1.0, 0.0]
    omegas = TURN_RATE * np.sin(np.array(action) * LARGEST)
    omegas[2] = 3.0  # which no steering gives
    [found] = asked(told(omegas, [0, 100, 200, 300]), ConstantGuide(0.0))
    np.testing.assert_allclose(found.steering[RECORDED].action, action, atol=1e-12)
    assert found.steering[RECORDED].omega[2] == 3.0


def test_recordings_side_by_side_give_what_each_gives_alone(tmp_path):
    paths = [drive(tmp_path / f"{scans}.mcap", scans, seed=scans) for scans in (4, 7)]
    both = asked(paths, SplineGuide())
    for path, found, scans in zip(paths, both, (4, 7), strict=True):
        [alone] = asked(path, SplineGuide())
        assert len(found.valid) == len(found.steering["0"].action) == scans
        np.testing.assert_array_equal(found.steering["0"].smoothness, alone.steering["0"].smoothness)


def test_what_a_policy_draws_depends_on_the_seed_and_not_on_who_was_asked_before():
    def drawing():
        return TensorDictModule(lambda seen: torch.rand(len(seen), 1), in_keys=["observation"], out_keys=["action"])

    [both], [other] = (asked(told(), drawing(), drawing(), seed=seed) for seed in (0, 1))
    np.testing.assert_array_equal(both.steering["0"].action, both.steering["1"].action)
    assert (both.steering["0"].action != other.steering["0"].action).all()


def test_every_scan_of_every_policy_is_announced():
    names = []
    asked(told(), ConstantGuide(0.0), ConstantGuide(1.0), tick=names.append)
    assert names == ["0"] * 4 + ["1"] * 4
