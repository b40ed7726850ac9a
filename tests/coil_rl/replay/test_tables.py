import math
from pathlib import Path

import numpy as np
import pytest

from coil_rl.envs import Recording
from coil_rl.replay import RECORDED, OpenLoop, describe, draw_steering, over_time
from coil_rl.replay.open_loop import Steering
from coil_rl.replay.tables import disagreement, extent, farthest, notes


def steering(*actions):
    actions = np.array(actions)
    return Steering(actions, actions / 2, np.abs(actions) / 4)


def made(cut_off=False, **steerings):
    times, ones = np.arange(4) * 10**9, np.ones(4)
    recording = Recording(
        Path("drive.mcap"),
        cut_off,
        times,
        times,
        np.ones((4, 9), np.float32),
        ones,
        ones,
        ones,
        notes={"simulated": {}},
    )
    valid = np.array([[1, 1], [1, 0], [0, 0], [1, 1]], dtype=bool)
    return OpenLoop(
        recording, np.zeros((4, 2, 1, 2)), np.zeros((4, 2)), np.zeros((4, 20)), valid, steerings, math.radians(80)
    )


@pytest.fixture
def found():
    return made(
        left=steering(1.0, 1.0, 1.0, 1.0),
        both=steering(1.0, -1.0, 1.0, -1.0),
        recorded=steering(math.nan, 0.0, 0.0, 0.5),
    )


def test_disagreement_is_a_mean_over_what_is_known_of_both(found):
    assert disagreement(found, "left", "both") == disagreement(found, "both", "left") == 1.0
    assert disagreement(found, "left", RECORDED) == pytest.approx((1 + 1 + 0.5) / 3)
    assert disagreement(found, "left", "left") == 0.0
    assert farthest(found) == (pytest.approx(3.5 / 3), "both", RECORDED)


def test_a_single_policy_disagrees_with_nobody():
    alone = made(left=steering(1.0, 1.0, 1.0, 1.0))
    assert farthest(alone) is None
    assert "from" not in describe(alone)


def test_table_has_a_row_and_a_column_for_each(found):
    text = describe(found)
    assert "## drive.mcap (simulated)" in text
    assert "4 scans in 3.0 s; both boundaries valid in 50% of them." in text
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    assert rows[0] == ["policy", "smoothness", "omega (rad/s)", "from left", "from both", "from recorded"]
    assert rows[2:] == [
        ["left", "0.250", "0.500", "-", "1.000", "0.833"],
        ["both", "0.250", "0.500", "1.000", "-", "1.167"],
        ["recorded", "0.042", "0.083", "0.833", "1.167", "-"],
    ]
    assert "fractions of 80 degrees" in notes(found.largest)


def test_a_file_that_is_cut_off_is_said_to_be():
    assert "4 scans in 3.0 s, all that can be read of a file that is cut off" in extent(made(cut_off=True))


def test_every_scan_has_a_row_with_steering_and_omega_of_each(found):
    rows = over_time(found)
    assert [(row["time"], row["valid"]) for row in rows] == [(0.0, 1), (1.0, 0), (2.0, 0), (3.0, 1)]
    assert rows[1]["both/steering"] == -1.0
    assert rows[1]["both/omega"] == -0.5
    assert math.isnan(rows[0]["recorded/omega"])


def test_the_same_replay_makes_the_same_picture(found, tmp_path):
    for name in ("one.png", "other.png"):
        draw_steering(found, tmp_path / name, title="drive")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "other.png").read_bytes()
    assert len((tmp_path / "one.png").read_bytes()) > 10_000
