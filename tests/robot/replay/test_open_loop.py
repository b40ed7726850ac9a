"""Open-loop evaluation of policies on recordings, and its report."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from drives import blind
from tensordict.nn import TensorDictModule

from coil_rl.envs import McapReplayEnv, Recording
from coil_rl.guides import ConstantGuide
from coil_robot.replay.open_loop import RECORDED, OpenLoop, Steering, open_loop, recorded_steering
from coil_robot.replay.report import describe, disagreement, extent, outcome

TURN_RATE, MAX_STEERING = 0.15 / (2 / 7), math.radians(80)


def recording(omegas=(), times=(), scans=4, period=100, **options):
    """A recording of scans at 0, 100, 200 ... ns with commands at other times."""
    scan_times, ones = np.arange(scans) * period, np.ones(scans)
    if len(omegas):
        commands = np.stack([np.full(len(omegas), 0.15), omegas], axis=1)
        options["commands"] = commands, np.array(times)
    ranges, points = np.ones((scans, 9), np.float32), ones.astype(int) * 9
    return Recording(
        Path("drive.mcap"), scan_times, scan_times, ranges, points, -ones, ones / 9, **options
    )


def run(recordings, *guides, **options):
    env = McapReplayEnv(recordings, blind)
    return open_loop(env, {str(n): (env, guide) for n, guide in enumerate(guides)}, **options)


def test_smoothness_and_omega_are_those_of_the_cone_world():
    [result] = run(recording(), ConstantGuide(0.5))
    steering = result.steering["0"]
    assert steering.action.tolist() == [0.5] * 4
    np.testing.assert_allclose(steering.omega, TURN_RATE * math.sin(MAX_STEERING / 2), rtol=1e-6)
    weights = np.exp(-0.1 * np.arange(20))
    expected = [0.5 - 0.5 * weights[:before].sum() / weights.sum() for before in range(4)]
    np.testing.assert_allclose(steering.smoothness, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        ([0, 100, 200, 300], [0.1, 0.2, 0.3, 0.4]),  # at the times of the scans
        ([30, 130, 230, 330], [0.1, 0.2, 0.3, 0.4]),  # a little later
        ([30, 60, 230, 250], [0.2, 0.2, 0.4, 0.4]),  # the last before the next scan
        ([110, 120, 130, 140], [math.nan, 0.4, 0.4, 0.4]),  # unknown before the first
        ([-90, -80, -70, -60], [0.4, 0.4, 0.4, 0.4]),
    ],
)
def test_command_of_a_scan_is_the_last_one_before_the_next_scan(times, expected):
    [result] = run(recording([0.1, 0.2, 0.3, 0.4], times), ConstantGuide(0.0))
    np.testing.assert_array_equal(result.steering[RECORDED].omega, expected)


def test_recorded_action_has_the_recorded_turn_rate_or_is_the_maximum():
    action = [0.25, -1.0, 1.0, 0.0]
    omegas = TURN_RATE * np.sin(np.array(action) * MAX_STEERING)
    omegas[2] = 3.0  # beyond the greatest turn rate
    [result] = run(recording(omegas, [0, 100, 200, 300]), ConstantGuide(0.0))
    np.testing.assert_allclose(result.steering[RECORDED].action, action, atol=1e-12)
    assert result.steering[RECORDED].omega[2] == 3.0


def test_scans_before_the_first_command_are_left_out_and_a_stop_is_straight():
    two, speeds = recording([0.15, 0.3], [110, 210], scans=5), np.array([[0.3, 0.15], [0.0, 0.15]])
    vars(two)["commands"] = speeds, two.commands[1]
    steering = recorded_steering(two, 0.15, 2 / 7, MAX_STEERING)
    action = math.asin(0.15 / 0.3 * 2 / 7) / MAX_STEERING
    np.testing.assert_allclose(steering.action, [math.nan, action, 0, 0, 0])
    assert steering.smoothness[1] == steering.action[1]
    with pytest.raises(ValueError, match="has no commands"):
        recorded_steering(recording(), 0.15, 2 / 7, MAX_STEERING)


def test_smoothness_passes_over_scans_without_a_command():
    """A robot that turns evenly steers smoothly, also where its commands are missing."""
    scans, second = 80, 10**9
    times = np.delete(np.arange(scans), np.s_[40:60]) * second
    drive = recording(np.full(len(times), 0.2), times, scans=scans, period=second)
    steering = recorded_steering(drive, 0.15, 2 / 7, MAX_STEERING)
    unknown = np.isnan(steering.action)
    assert unknown[44:60].all()
    np.testing.assert_array_equal(np.isnan(steering.smoothness), unknown)
    np.testing.assert_allclose(steering.smoothness[20:][~unknown[20:]], 0.0, atol=1e-12)


def test_random_draws_of_a_policy_depend_on_the_seed_alone():
    drawing = TensorDictModule(lambda x: torch.rand(len(x), 1), ["observation"], ["action"])
    [both], [other] = (run(recording(), drawing, drawing, seed=seed) for seed in (0, 1))
    np.testing.assert_array_equal(both.steering["0"].action, both.steering["1"].action)
    assert (both.steering["0"].action != other.steering["0"].action).all()


def result_of(remarks=(), **actions):
    """A result with given actions; both sides are valid in the first and the last of 4 scans."""
    steering = {}
    for name, given in actions.items():
        action = np.array(given)
        steering[name] = Steering(action, action / 2, np.abs(action) / 4)
    valid = np.array([[1, 1], [1, 0], [0, 0], [1, 1]], dtype=bool)
    one = recording(period=10**9, notes={"simulated": {}})
    vars(one)["remarks"] = remarks
    arrays = np.zeros((4, 2, 1, 2)), np.zeros((4, 2)), np.zeros((4, 20))
    return OpenLoop(one, *arrays, valid, steering, env=None)


@pytest.fixture
def result():
    recorded = [math.nan, 0.0, 0.0, 0.5]
    return result_of(left=[1.0] * 4, both=[1.0, -1.0, 1.0, -1.0], recorded=recorded)


def test_disagreement_is_a_mean_over_the_scans_with_both_known(result):
    distances = disagreement(result)
    assert distances.loc["left", "both"] == distances.loc["both", "left"] == 1.0
    assert distances.loc["left", RECORDED] == pytest.approx((1 + 1 + 0.5) / 3)
    assert outcome(result).endswith("; both and recorded disagree most, by 1.167 on average")
    alone = result_of(left=[1.0] * 4)
    assert "disagree" not in outcome(alone)
    assert "from" not in describe(alone)


def test_table_has_a_row_and_a_column_per_policy(result):
    text = describe(result)
    assert "## drive.mcap (simulated)" in text
    assert "4 scans in 3.0 s, 1.0 a second; both boundaries valid in 50% of them." in text
    lines = [line for line in text.splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    assert rows[0][:4] == ["policy", "smoothness", "omega (rad/s)", "from left"]
    assert rows[2:] == [
        ["left", "0.250", "0.500", "-", "1.000", "0.833"],
        ["both", "0.250", "0.500", "1.000", "-", "1.167"],
        ["recorded", "0.042", "0.083", "0.833", "1.167", "-"],
    ]
    assert extent(result_of(["is cut off", "is odd"])).endswith(
        "50% of them; the file is cut off; the file is odd"
    )
