"""Recorded drives of guides and agents, and their reuse."""

import dataclasses

import pytest
from run_folders import make_untrained_run

from coil_rl.envs import SimulatedRobotEnv
from coil_rl.errors import UserError
from coil_rl.guides import SplineGuide
from coil_rl.robot.drivers import Driver, agent_driver, record
from coil_rl.train import checkpoint
from coil_rl.train.run_folder import read_config


def robots():
    return SimulatedRobotEnv(num_envs=2, time_limit=1.0)


@pytest.fixture
def guide():
    """A driver, and a list with an entry for each of its drives."""
    drives = []

    def make_env_and_policy():
        drives.append(True)
        return robots(), SplineGuide()

    return Driver("guide", {"policy": "guide"}, make_env_and_policy), drives


def test_existing_recordings_are_reused(guide, tmp_path):
    driver, drives = guide
    first = record([driver], tmp_path, 2)
    assert [recording.path.name for recording in first] == ["guide_0.mcap", "guide_1.mcap"]
    before = [recording.path.stat().st_mtime_ns for recording in first]
    again = record([driver], tmp_path, 2)
    assert [recording.path.stat().st_mtime_ns for recording in again] == before
    assert (again[1].ranges == first[1].ranges).all()
    assert len(drives) == 1


def test_other_notes_and_missing_or_damaged_files_are_recorded_again(guide, tmp_path):
    driver, drives = guide
    record([driver], tmp_path, 2)
    other = dataclasses.replace(driver, about={"policy": "guide", "gain": "2"})
    assert record([other], tmp_path, 2)[0].notes["simulated"]["gain"] == "2"
    record([other], tmp_path, 2, {"laps": "1"})
    assert len(drives) == 3
    (tmp_path / "guide_1.mcap").unlink()
    record([other], tmp_path, 2, {"laps": "1"})
    (tmp_path / "guide_0.mcap").write_bytes((tmp_path / "guide_0.mcap").read_bytes()[:-200])
    record([other], tmp_path, 2, {"laps": "1"})
    assert len(drives) == 5


def test_agent_with_other_weights_is_recorded_again(tmp_path):
    run = make_untrained_run(tmp_path / "mine", "method=coil", "seed=3", "track=generated", "track.train.count=1")
    config = read_config(run, "run")
    (first, _) = record([agent_driver(run, config, robots)], tmp_path / "drives", 2)
    notes = first.notes["simulated"]
    assert first.path.name == "mine_0.mcap"
    assert (notes["policy"], notes["seed"], notes["run"]) == ("coil", "3", "mine")
    state = checkpoint.load(run / "policy_last.pt")
    checkpoint.save({name: weight + 0.1 for name, weight in state.items()}, run / "policy_last.pt")
    (second, _) = record([agent_driver(run, config, robots)], tmp_path / "drives", 2)
    assert (second.commands[0] != first.commands[0]).any()


def test_run_without_an_agent_is_refused(tmp_path):
    run = make_untrained_run(tmp_path / "guide", "method=guide", "track=generated", "track.train.count=1")
    with pytest.raises(UserError, match="has no agent"):
        record([agent_driver(run, read_config(run, "run"), robots)], tmp_path, 2)
