import numpy as np
import pytest
import torch
from mcap.reader import make_reader
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from coil_rl.envs import (
    ConeTrackEnv,
    McapReplayEnv,
    Perception,
    RecordingError,
    SimulatedRobotEnv,
    read_recording,
    record_drives,
    robot_track,
    save_drive,
    simulated_cone_classifier,
    simulated_drive,
)
from coil_rl.envs.robot.simulated_recordings import surveyed_drive, track_of
from coil_rl.guides import ConstantGuide, FollowAdvice, SplineGuide
from coil_rl.transforms import GuideActions


def metadata(path):
    with path.open("rb") as file:
        return {entry.name: dict(entry.metadata) for entry in make_reader(file).iter_metadata()}


def test_a_labelling_drive_reads_back_and_says_that_it_is_simulated(tmp_path):
    drive, path = simulated_drive("left", seed=3), tmp_path / "left.mcap"
    save_drive(drive, path)
    recording = read_recording(path, strict=True)
    assert recording.simulated
    assert np.array_equal(recording.ranges, drive.ranges.numpy())
    np.testing.assert_allclose(recording.angles(0), drive.angles, atol=1e-6)
    np.testing.assert_allclose(recording.seconds, drive.seconds, atol=1e-8)
    np.testing.assert_allclose(recording.poses()[:, :2], drive.poses[:2, :, 0].t(), atol=1e-6)
    assert metadata(path)["simulated"]["drive"] == "left_3"


@pytest.fixture(scope="module")
def live():
    """What two robots saw and did in 25 steps of the guide."""
    env = SimulatedRobotEnv(num_cars=2, time_limit=25 / 5.5, seed=4)
    rows, state = [], env.reset()
    for _ in range(25):
        step = env.step(SplineGuide()(state))
        rows.append(step)
        state = step_mdp(step)
    return torch.stack(rows, 1)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    paths = [tmp_path_factory.mktemp("drives") / f"{robot}.mcap" for robot in (0, 1)]
    env = SimulatedRobotEnv(num_cars=2, time_limit=25 / 5.5, seed=4)
    record_drives(env, SplineGuide(), paths, {"policy": "spline"})
    return paths


def test_the_replay_shows_what_the_robot_saw_and_what_it_was_told(files, live):
    replay = McapReplayEnv(files, Perception(simulated_cone_classifier()))
    again = replay.rollout(100, SplineGuide())
    assert again.shape == live.shape
    for key in ("cones", "observation", "action"):
        torch.testing.assert_close(again[key], live[key], atol=1e-3, rtol=0)
    assert torch.equal(again["cone_count"], live["cone_count"])
    assert torch.equal(again["info", "valid"], live["info", "valid"])
    for robot, path in enumerate(files):
        told, _ = read_recording(path).commands
        expected = (live["action"][robot, :, 0] * np.radians(80)).sin() * 0.15 / (2 / 7)
        np.testing.assert_allclose(told[:, 1], expected, atol=1e-6)
        np.testing.assert_allclose(told[:, 0], 0.15, atol=1e-6)


def test_odometry_tells_where_each_turn_began(files, live):
    poses = read_recording(files[0]).poses()
    # The first turn was made standing at the start, and each later one began where the robot was a step before.
    np.testing.assert_allclose(poses[0], live["info", "pose"][0, 0], atol=1e-6)
    np.testing.assert_allclose(poses[1:], live["info", "pose"][0, :-1], atol=1e-6)


def test_a_recording_ends_with_its_robots_episode(tmp_path):
    env = SimulatedRobotEnv(num_cars=1)
    record_drives(env, ConstantGuide(1.0), [tmp_path / "crash.mcap"])
    recording = read_recording(tmp_path / "crash.mcap")
    assert 5 < len(recording.log_time) == int(env.steps) < 40
    assert metadata(tmp_path / "crash.mcap")["simulated"]["drive"] == "closed loop"


def test_the_same_drive_is_the_same_file(tmp_path):
    drive = simulated_drive("right", seed=0)
    for name in ("a", "b"):
        save_drive(drive, tmp_path / f"{name}.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_there_must_be_a_file_for_each_robot(tmp_path):
    with pytest.raises(ValueError, match="1 paths for 2 robots"):
        record_drives(SimulatedRobotEnv(num_cars=2), SplineGuide(), [tmp_path / "a.mcap"])


def test_a_drive_past_both_sides_tells_where_the_cones_stood(files, tmp_path):
    for side in ("left", "both"):
        save_drive(simulated_drive(side, seed=3), tmp_path / f"{side}.mcap")
    assert "track" not in read_recording(tmp_path / "left.mcap").notes
    for path in (*files, tmp_path / "both.mcap"):
        track = track_of(read_recording(path))
        assert np.array_equal(track.left, robot_track().left)


def test_a_robot_with_transforms_is_recorded_as_one_without(files, tmp_path):
    env = SimulatedRobotEnv(num_cars=2, time_limit=25 / 5.5, seed=4)
    advised = TransformedEnv(env, GuideActions({"spline": SplineGuide()}))
    record_drives(advised, FollowAdvice(advised), [tmp_path / "0.mcap", tmp_path / "1.mcap"], {"policy": "spline"})
    for robot, path in enumerate(files):
        assert (tmp_path / f"{robot}.mcap").read_bytes() == path.read_bytes()


def test_only_simulated_robots_are_recorded(ring):
    with pytest.raises(ValueError, match="env is a ConeTrackEnv; give a SimulatedRobotEnv"):
        record_drives(ConeTrackEnv([ring]), SplineGuide(), ["a.mcap"])


def test_what_does_not_note_a_track_is_no_surveyed_drive(tmp_path):
    save_drive(simulated_drive("left", seed=3), tmp_path / "left.mcap")
    with pytest.raises(RecordingError, match="does not tell where its cones stood"):
        surveyed_drive(read_recording(tmp_path / "left.mcap"))
