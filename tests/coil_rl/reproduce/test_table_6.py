import csv

import numpy as np
import pytest
import torch
from drives import drive as circle
from PIL import Image
from run_folders import make_untrained_run

from coil_rl.envs import RecordingError, SimulatedRobotEnv, read_recording, record_drives
from coil_rl.errors import UserError
from coil_rl.guides import ConstantGuide, SplineGuide
from coil_rl.report.runs import Run
from coil_rl.reproduce import Table6
from coil_rl.train.evaluation import evaluate_policy


@pytest.fixture(scope="module")
def crash(tmp_path_factory):
    """A robot that steers to the left until it crashes, and another one that the guide drives for 20 seconds."""
    folder = tmp_path_factory.mktemp("drives")
    record_drives(SimulatedRobotEnv(seed=4), ConstantGuide(1.0), [folder / "crash.mcap"], {"policy": "constant"})
    env = SimulatedRobotEnv(num_cars=2, time_limit=20.0, seed=4)
    record_drives(env, SplineGuide(), [folder / "0.mcap", folder / "1.mcap"], {"policy": "guide"})
    return folder


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_recordings_tell_what_the_simulation_measured(crash, tmp_path):
    page = Table6(recordings=[str(crash)]).make(tmp_path / "table_6")
    rows = {row["recording"]: row for row in rows_of(tmp_path / "table_6.csv")}
    live = evaluate_policy(SimulatedRobotEnv(num_cars=2, time_limit=20.0, seed=4), SplineGuide()).episodes
    for robot, episode in enumerate(live):
        row = rows[f"{robot}.mcap"]
        assert float(row["smoothness"]) == pytest.approx(episode["smoothness"], abs=1e-5)
        assert float(row["clearance"]) == pytest.approx(episode["clearance"], abs=1e-5)
        assert row["crashed"] == "False"
        assert float(row["off_centre"]) < 0.05
    (ended,) = evaluate_policy(SimulatedRobotEnv(seed=4), ConstantGuide(1.0)).episodes
    assert rows["crash.mcap"]["crashed"] == "True"
    assert float(rows["crash.mcap"]["clearance"]) == pytest.approx(ended["clearance"], abs=1e-5)
    assert "## Table 6: the robot (simulated)" in page
    assert "| guide    |     - |      2 |    0 |       0 |" in page
    assert "sways, stays central" in page
    assert Image.open(tmp_path / "table_6.png").width == 1600


def test_a_recording_of_another_robot_has_what_its_odometry_and_commands_tell(tmp_path):
    file = circle(tmp_path / "mine.mcap", scans=250, odometry=True, commands=True)
    page = Table6(recordings=[str(file)]).make(tmp_path / "table_6")
    (row,) = rows_of(tmp_path / "table_6.csv")
    # On a circle of 1 m at 0.15 m/s; the same action is told all the time, which is new for twenty steps.
    assert float(row["lap_time"]) == pytest.approx(2 * np.pi / 0.15, rel=1e-3)
    assert row["laps"] == "1"
    action = np.arcsin(2 / 7) / np.radians(80)
    weights = np.exp(-0.1 * np.arange(20))
    jerks = action * (1 - np.append(0, weights.cumsum()) / weights.sum())
    assert float(row["smoothness"]) == pytest.approx(jerks.sum() / 250, rel=1e-3)
    assert row["crashed"] == row["method"].replace("mine", "") == ""
    assert "simulated" not in page
    assert "| mine   |     - |      1 |    1 |       - |" in page
    assert "held up" not in page


def test_without_odometry_a_robot_did_what_it_was_told(tmp_path):
    file = circle(tmp_path / "mine.mcap", scans=250, commands=True)
    Table6(recordings=[str(file)]).make(tmp_path / "table_6")
    (row,) = rows_of(tmp_path / "table_6.csv")
    assert float(row["lap_time"]) == pytest.approx(2 * np.pi / 0.15, rel=1e-2)


def test_drivers_can_be_named(crash, tmp_path):
    recordings = {"coil": [str(crash / "0.mcap")], "ppo": [str(crash / "1.mcap")]}
    Table6(recordings=recordings).make(tmp_path / "table_6")
    assert [row["method"] for row in rows_of(tmp_path / "table_6.csv")] == ["coil", "ppo"]


def test_the_last_place_is_in_the_recording(crash):
    env = SimulatedRobotEnv(seed=4)
    state = env.rollout(200, ConstantGuide(1.0))
    poses, _, _ = read_recording(crash / "crash.mcap").odometry
    torch.testing.assert_close(torch.from_numpy(poses[-1]).float(), state["next", "info", "pose"][0, -1])


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Agents that have learned nothing, and a guide that only steers to the left: all of them crash soon."""
    folder = tmp_path_factory.mktemp("runs")
    chosen = ["guide=constant", "guide.constant.value=1", "track=generated", "track.train.count=1"]
    made = [("ppo", 0), ("coil", 0), ("coil", 1)]
    for label, seed in made:
        make_untrained_run(folder / f"{label}_{seed}", f"method={label}", f"seed={seed}", *chosen)
    return {"mine": [Run(folder / f"{label}_{seed}", label, seed, None) for label, seed in made]}


def test_without_recordings_the_guide_and_the_agents_drive_and_are_recorded_once(runs, tmp_path):
    table = Table6(["mine"], labels=["ppo", "coil"], repeats=1)
    assert table.experiments == ["mine"]
    page = table.make(tmp_path / "table_6", runs)
    rows = rows_of(tmp_path / "table_6.csv")
    drivers = [("guide", ""), ("ppo", "0"), ("coil", "0"), ("coil", "1")]
    assert [(row["method"], row["seed"]) for row in rows] == drivers
    assert "(simulated)" in page
    drives = {path: path.stat().st_mtime_ns for path in (tmp_path / "table_6_drives").iterdir()}
    assert len(drives) == 4
    # From the recordings alone, whoever asks and whatever drove.
    assert Table6(["mine"], labels=["ppo", "coil"], repeats=1).make(tmp_path / "table_6", runs) == page
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "table_6_drives").iterdir()} == drives
    again = Table6(["mine"], recordings=[str(tmp_path / "table_6_drives")])
    assert again.experiments == []
    again.make(tmp_path / "again")
    assert sorted(map(str, rows_of(tmp_path / "again.csv"))) == sorted(map(str, rows))


def test_a_label_that_no_run_has_is_refused(runs, tmp_path):
    with pytest.raises(UserError, match="no run of mine is called oil; there are ppo, coil"):
        Table6(["mine"], labels=["oil"]).make(tmp_path / "table_6", runs)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "leave nobody to drive"),
        ({"experiments": ["mine"], "repeats": 0}, "repeats=0 must be at least 1"),
        ({"experiments": ["mine"], "labels": []}, "labels=.. leaves the guide alone"),
    ],
)
def test_a_table_of_nobody_is_refused(given, words):
    with pytest.raises((UserError, ValueError), match=words):
        Table6(**given)


def test_a_folder_of_nothing_and_what_is_no_recording_are_refused(tmp_path):
    with pytest.raises(UserError, match="holds no MCAP file"):
        Table6(recordings=[str(tmp_path)])
    (tmp_path / "none.mcap").write_bytes(b"none")
    with pytest.raises(RecordingError, match="is not an MCAP file"):
        Table6(recordings=[str(tmp_path / "none.mcap")])
