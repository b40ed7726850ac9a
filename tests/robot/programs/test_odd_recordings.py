"""Odd recordings through coil-replay: nothing ends in a traceback, and nothing goes unsaid."""

import csv

import numpy as np
import pytest
from odd_recordings import good_drive, make_odd
from programs import called

TOLERANCE = 0.01  # of the steering, for recordings that only look odd


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return good_drive(tmp_path_factory.mktemp("good"))


def replayed(recording, out):
    """What the program says, its exit code, and the steering of the guide and of the commands."""
    done = called("replay", f"recording={recording}", f"hydra.run.dir={out}", code=None)
    said = (done.stdout + done.stderr).replace(str(recording.parent), "")
    if done.returncode:
        return said, done.returncode, None
    with (out / "steering.csv").open(newline="") as file:
        rows = [
            (row["spline/steering"], row.get("recorded/steering")) for row in csv.DictReader(file)
        ]
    steering = [[float(number) if number else np.nan for number in row] for row in rows]
    return said, 0, np.array(steering)


@pytest.mark.slow
def test_each_odd_recording_is_refused_said_or_gives_the_same_steering(good, tmp_path):
    _, _, expected = replayed(good, tmp_path / "good_results")
    unsaid = []
    for path, words in make_odd(tmp_path / "odd", good).items():
        said, code, steering = replayed(path, tmp_path / "results" / path.stem / path.parent.name)
        assert code in (0, 2), path
        assert "Traceback" not in said, path
        if words is None:
            np.testing.assert_allclose(steering, expected, atol=TOLERANCE, err_msg=str(path))
        elif words not in said:
            unsaid.append(path)
    assert not unsaid
