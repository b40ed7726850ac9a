"""Recorded drives of guides and agents, and their reuse."""

import pytest

from coil_paper.reproduce.recorded_drives import record
from coil_rl.envs import SimulatedRobotEnv
from coil_rl.guides import SplineGuide


@pytest.fixture
def guide():
    """Return a function that makes robots and their guide, and a list that grows at each drive."""
    drives = []

    def make_env_and_policy():
        drives.append(True)
        return SimulatedRobotEnv(num_envs=2, time_limit=1.0), SplineGuide()

    return make_env_and_policy, drives


def test_existing_recordings_are_reused(guide, tmp_path):
    make, drives = guide
    paths = [tmp_path / "guide_0.mcap", tmp_path / "guide_1.mcap"]
    first = record(make, paths, {"policy": "guide"})
    assert [recording.path for recording in first] == paths
    before = [path.stat().st_mtime_ns for path in paths]
    again = record(make, paths, {"policy": "guide"})
    assert [path.stat().st_mtime_ns for path in paths] == before
    assert (again[1].ranges == first[1].ranges).all()
    assert len(drives) == 1


def test_other_notes_and_missing_or_damaged_files_are_recorded_again(guide, tmp_path):
    make, drives = guide
    paths, notes = [tmp_path / "0.mcap", tmp_path / "1.mcap"], {"policy": "guide", "gain": "2"}
    record(make, paths, {"policy": "guide"})
    assert record(make, paths, notes)[0].notes["simulated"]["gain"] == "2"
    assert len(drives) == 2
    paths[1].unlink()
    record(make, paths, notes)
    paths[0].write_bytes(paths[0].read_bytes()[:-200])
    record(make, paths, notes)
    assert len(drives) == 4
