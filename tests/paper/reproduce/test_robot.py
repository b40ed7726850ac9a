import math

import numpy as np
import pytest
import torch
from drives import drive as circle
from programs import read_csv
from reproduced_runs import row
from run_folders import make_untrained_run
from worlds import driving_measures

from coil_paper.reproduce.robot import Table6, robot_page
from coil_rl.envs import (
    McapReplayEnv,
    Perception,
    RecordingError,
    SimulatedRobotEnv,
    read_recording,
    record_drives,
    robot_tracks,
    simulated_cone_classifier,
)
from coil_rl.errors import UserError
from coil_rl.guides import ConstantGuide, SplineGuide
from coil_rl.report.runs import Run
from coil_rl.run import checkpoint
from coil_rl.run.evaluation import evaluate_policy


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """A crash of a robot with constant steering, and two drives of the guide."""
    folder = tmp_path_factory.mktemp("drives")
    crash = [folder / "crash.mcap"]
    record_drives(SimulatedRobotEnv(seed=4), ConstantGuide(1.0), crash, {"policy": "constant"})
    env = SimulatedRobotEnv(num_envs=2, time_limit=20.0, seed=4)
    record_drives(env, SplineGuide(), [folder / "0.mcap", folder / "1.mcap"], {"policy": "guide"})
    return folder


@pytest.mark.slow
def test_measures_of_recordings_equal_those_of_the_simulation(recordings, tmp_path):
    page = Table6(recordings=[str(recordings)]).make(tmp_path / "table_6")
    rows = {line["recording"]: line for line in read_csv(tmp_path / "table_6.csv")}
    measured = driving_measures("simulated_robot")
    env = SimulatedRobotEnv(num_envs=2, time_limit=20.0, seed=4)
    live = evaluate_policy(env, SplineGuide(), measures=measured).episodes
    for robot, episode in enumerate(live):
        recorded = rows[f"{robot}.mcap"]
        assert float(recorded["smoothness"]) == pytest.approx(episode["smoothness"], abs=1e-5)
        assert float(recorded["clearance"]) == pytest.approx(episode["clearance"], abs=1e-5)
        assert recorded["crashed"] == "False"
        assert float(recorded["off_centre"]) < 0.05
    (crash,) = evaluate_policy(
        SimulatedRobotEnv(seed=4), ConstantGuide(1.0), measures=measured
    ).episodes
    assert rows["crash.mcap"]["crashed"] == "True"
    assert float(rows["crash.mcap"]["clearance"]) == pytest.approx(crash["clearance"], abs=1e-5)
    assert row(page, "guide ")[:5] == ["guide", "-", "2", "0", "0"]
    assert (tmp_path / "table_6.png").exists()


def test_another_robots_recording_is_measured_by_odometry_or_commands(tmp_path):
    file = circle(tmp_path / "mine.mcap", scans=250, odometry=True, commands=True)
    page = Table6(recordings=[str(file)]).make(tmp_path / "table_6")
    (measured,) = read_csv(tmp_path / "table_6.csv")
    # A circle of 1 m at 0.15 m/s, with a constant action from the start.
    assert float(measured["lap_time"]) == pytest.approx(2 * np.pi / 0.15, rel=1e-3)
    assert measured["laps"] == "1"
    action = np.arcsin(2 / 7) / np.radians(80)
    weights = np.exp(-0.1 * np.arange(20))
    steps = action * (1 - np.append(0, weights.cumsum()) / weights.sum())
    assert float(measured["smoothness"]) == pytest.approx(steps.sum() / 250, rel=1e-3)
    assert (measured["crashed"], measured["method"]) == ("", "mine")
    assert "simulated" not in page
    assert "held up" not in page
    file = circle(tmp_path / "commands.mcap", scans=250, commands=True)
    Table6(recordings={"named": [str(file)]}).make(tmp_path / "commands")
    (integrated,) = read_csv(tmp_path / "commands.csv")
    assert integrated["method"] == "named"
    assert float(integrated["lap_time"]) == pytest.approx(2 * np.pi / 0.15, rel=1e-2)


ONE_TRACK = ["track=generated", "track.train.count=1"]
CRASHING = ["guide=constant", "guide.constant.value=1", *ONE_TRACK]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Untrained agents and a guide with constant steering, which all crash soon."""
    folder = tmp_path_factory.mktemp("runs")
    made = [("ppo", 0), ("coil", 1)]
    for label, seed in made:
        make_untrained_run(folder / f"{label}_{seed}", f"method={label}", f"seed={seed}", *CRASHING)
    return {"mine": [Run(folder / f"{label}_{seed}", label, seed, None) for label, seed in made]}


@pytest.mark.slow
def test_without_recordings_the_guide_and_the_agents_drive_and_are_recorded_once(runs, tmp_path):
    table = Table6(["mine"], labels=["ppo", "coil"], repeats=1)
    assert table.experiments == ["mine"]
    page = table.make(tmp_path / "table_6", runs)
    rows = read_csv(tmp_path / "table_6.csv")
    drivers = [(line["method"], line["seed"]) for line in rows]
    assert drivers == [("guide", ""), ("ppo", "0"), ("coil", "1")]
    folder = tmp_path / "table_6_drives"
    drives = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert len(drives) == 3
    table = Table6(["mine"], labels=["ppo", "coil"], repeats=1)
    assert table.make(tmp_path / "table_6", runs) == page
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == drives
    again = Table6(["mine"], recordings=[str(folder)])
    assert again.experiments == []
    again.make(tmp_path / "again")
    assert sorted(map(str, read_csv(tmp_path / "again.csv"))) == sorted(map(str, rows))


@pytest.mark.slow
def test_all_drive_on_further_tracks_too(runs, tmp_path):
    worlds = {"cones missing": robot_tracks(missing=0.2, seed=1)}
    table = Table6(["mine"], labels=["ppo"], repeats=1, worlds=worlds)
    page = table.make(tmp_path / "table_6", runs)
    rows = read_csv(tmp_path / "table_6.csv")
    expected = [(name, world) for world in ("", "cones missing") for name in ("guide", "ppo")]
    assert [(line["method"], line["world"]) for line in rows] == expected
    assert page.count("Cones missing") == 1
    with_cones, without = (len(drive.track.left) for drive in table.drives[::2])
    assert without < with_cones


def robots_of(run, folder):
    """Return the recordings of the agent of a run: one robot, and a lap at most."""
    Table6(runs=[str(run)], repeats=1, laps=1).make(folder / "own")
    return read_recording(folder / "own_drives" / f"{run.name}_0.mcap")


@pytest.mark.slow
def test_own_runs_drive_with_any_label_and_again_with_other_weights(tmp_path):
    words = ["method=coil", "seed=3", *CRASHING, "label=mine"]
    run = make_untrained_run(tmp_path / "run", *words)
    first = robots_of(run, tmp_path)
    assert [line["method"] for line in read_csv(tmp_path / "own.csv")] == ["guide", "mine"]
    notes = first.notes["simulated"]
    assert (notes["policy"], notes["seed"], notes["run"]) == ("mine", "3", "run")
    state = checkpoint.load(run / "policy_last.pt")
    checkpoint.save({name: weight + 0.1 for name, weight in state.items()}, run / "policy_last.pt")
    assert (robots_of(run, tmp_path).commands[0][0] != first.commands[0][0]).any()


@pytest.mark.slow
def test_recorded_command_is_the_transformed_action(tmp_path):
    words = ["method=residual", "learner.action_gain=1.0", *ONE_TRACK]
    recording = robots_of(make_untrained_run(tmp_path / "residual", *words), tmp_path)
    env = McapReplayEnv(recording, Perception(simulated_cone_classifier()))
    guide = env.rollout(100, SplineGuide())
    turn_rate = torch.from_numpy(recording.commands[0][: guide.shape[1], 1])
    # An untrained residual agent adds little to its guide.
    advised = (guide["action"][0, :, 0] * torch.pi * 80 / 180).sin() * 0.15 / (2 / 7)
    assert 0 < (turn_rate - advised).abs().mean() < 0.2


@pytest.mark.slow
def test_run_without_an_agent_is_refused(tmp_path):
    run = make_untrained_run(tmp_path / "guide", "method=guide", *ONE_TRACK)
    with pytest.raises(UserError, match="has no agent"):
        robots_of(run, tmp_path)


KNOWN = {"crashed": False, "laps": 3, "lap_time": 40.0, "corner_cut": 1.0}
KNOWN |= {"off_centre": 0.02, "clearance": 0.04}
LOST = {"crashed": True, "laps": 0, "lap_time": math.nan, "corner_cut": math.nan}
LOST |= {"clearance": -0.01}


def drive(method, seed=None, **others):
    return KNOWN | {"method": method, "seed": seed, "world": "", "smoothness": 0.3} | others


def page_of(*drives):
    return robot_page(drives, "", 80.0)


@pytest.fixture(scope="module")
def page():
    """The page of invented drives; COIL completes no lap with one of three seeds."""
    coil = [drive("coil", seed, smoothness=0.1 + int(seed) / 100, lap_time=38.0) for seed in "01"]
    ppo = [drive("ppo", seed, smoothness=0.106, lap_time=39.0, clearance=0.02) for seed in "012"]
    guide = [drive("guide"), drive("guide", clearance=0.05)]
    return page_of(*guide, *ppo, *coil, drive("coil", "2", smoothness=0.2, **LOST))


def test_a_method_has_the_means_of_its_drives_next_to_the_paper(page):
    assert row(page, "guide ") == ["guide", "-", "2", "6", "0", "0.300", "0.265", "40.00", "43.67"]
    assert row(page, "coil ") == ["coil", "3", "3", "6", "1", "0.137", "0.082", "38.00", "39.53"]
    assert row(page, "guide ", 1) == ["guide", "0.020", "0.040", "1.000", "sways, stays central"]


@pytest.mark.parametrize(
    ("claim", "cells"),
    [
        (
            "PPO steers more smoothly than the guide",
            ["-0.163", "3 of 3", "**held up**: -0.194 (-0.194 to -0.194), 3 seeds, p < 0.001"],
        ),
        (
            "COIL steers more smoothly than PPO",
            ["-0.020", "2 of 3", "**undecided**: -0.001 (-0.065 to +0.063), 2 seeds, p 1.000"],
        ),
        (
            "COIL's laps",
            ["-0.61", "2 of 3", "**held up**: -1.00 (-1.00 to -1.00), 2 seeds, p < 0.001"],
        ),
    ],
)
def test_claims_have_a_verdict_by_the_seeds_with_a_complete_lap(claim, cells, page):
    assert row(page, claim)[1:] == cells


def test_crashes_are_counted_by_seed(page):
    _, paper, _, verdict = row(page, "Nobody crashes")
    assert (paper, verdict.partition(":")[0]) == ("0", "**did not hold up**")
    assert "guide 0 of 2 drives, ppo 0 of 3 (0% to 71%) seeds, coil 1 of 3" in verdict


def test_drives_without_a_complete_lap_are_compared_by_clearance_only():
    lost = page_of(drive("guide"), drive("ppo", "0", **LOST))
    assert row(lost, "PPO steers more smoothly")[2:] == ["0 of 1", "-"]
    assert row(lost, "PPO drives nearer")[2:] == ["1 of 1", "**undecided**: -0.050, 1 seed"]


def test_each_world_has_its_own_rows_and_claims():
    in_rain = [drive(name, "0", world="rain", smoothness=0.5) for name in ("coil", "ppo")]
    page = page_of(drive("guide"), drive("ppo", "0"), *in_rain)
    assert row(page, "ppo ")[5] == "0.300"
    rain = page.split("### Rain")[1]
    assert [row(rain, f"{name} ")[5] for name in ("coil", "ppo")] == ["0.500", "0.500"]
    assert row(page, "COIL steers more smoothly than PPO, rain")[2] == "1 of 1"


def test_an_agent_without_seed_leaves_claims_undecided_and_other_drivers_have_none():
    page = page_of(drive("guide"), drive("coil", smoothness=0.1))
    assert row(page, "COIL steers")[3] == "**undecided**: -0.200, 1 seed"
    assert "held up" not in page_of(drive("mine"), drive("guide"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "give no driver"),
        ({"experiments": ["mine"], "repeats": 0}, "repeats=0 must be at least 1"),
        ({"experiments": ["mine"], "labels": []}, "labels=.. must be at least 1 long"),
        ({"runs": ["empty"]}, "holds no run of coil-train"),
        ({"recordings": ["empty"]}, "has no MCAP file"),
        ({"recordings": ["none.mcap"]}, "is not an MCAP file"),
    ],
)
def test_mistakes_are_rejected(options, message, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "none.mcap").write_bytes(b"none")
    with pytest.raises((UserError, ValueError, RecordingError), match=message):
        Table6(**options)
