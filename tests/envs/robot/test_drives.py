"""Simulated drives with their ground truth, and recordings of drives."""

import numpy as np
import pytest
import torch
from drives import labelling_drives
from torchrl.envs import TransformedEnv

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
from coil_rl.envs.robot.course import middle_line
from coil_rl.envs.robot.drives import labelled_drive, track_of
from coil_rl.guides import ConstantGuide, FollowAdvice, SplineGuide
from coil_rl.transforms import GuideActions


@pytest.fixture(scope="module")
def both():
    return simulated_drive("both", seed=5)


def test_drive_is_a_lap_along_the_middle_with_five_and_a_half_scans_per_second(both):
    assert both.seconds[1].item() == pytest.approx(1 / 5.5)
    assert both.ranges.shape == both.hit.shape == (len(both.seconds), 360)
    assert both.seconds[-1].item() == pytest.approx(6 / 0.15, abs=1)
    line = torch.from_numpy(middle_line(robot_track(), 0.01)).float()
    assert 0.03 < torch.cdist(both.poses[:2].flatten(1).t(), line).amin(1).max() < 0.05
    speed = (both.poses[:2, 1:, -1] - both.poses[:2, :-1, -1]).norm(dim=0) * 5.5
    assert speed.median().item() == pytest.approx(0.15, rel=0.05)


def test_heading_is_tangential_and_the_robot_moves_during_a_scan(both):
    # The last beam is measured first.
    starts, ends = both.poses[..., -1], both.poses[..., 0]
    way = starts[:2, 1:] - starts[:2, :-1]
    bearing = torch.atan2(way[1], way[0]) - starts[2, :-1]
    off = torch.remainder(bearing + torch.pi, 2 * torch.pi) - torch.pi
    assert off.abs().max() < 0.05
    gaps = ends[:, :-1] - starts[:, 1:]
    assert gaps[:2].norm(dim=0).max() < 0.001
    assert (ends[:2] - starts[:2]).norm(dim=0).min() > 0.02


def test_ranges_end_at_the_surface_of_the_cone_they_hit(both):
    angle = both.poses[2] + both.angles
    ranges = torch.where(both.hit >= 0, both.ranges, 0)
    points = both.poses[:2] + ranges * torch.stack([angle.cos(), angle.sin()])
    hits = (both.hit >= 0) & both.ranges.isfinite()
    cone = both.hit[hits]
    off = (points[:, hits] - both.cones[:, cone]).norm(dim=0) - both.radius[cone]
    assert hits.sum() > 10_000
    # Noise along a beam that grazes a cone moves the point off its surface.
    assert off.abs().max() < 0.045


def test_visibility_is_the_share_of_a_cone_that_no_other_cone_hides(both):
    assert both.visibility.min() == 0
    assert both.visibility.max() == 1
    partly = (both.visibility > 0.01) & (both.visibility < 0.99)
    assert 0.03 < partly.float().mean() < 0.3
    nearest = (both.cones[:, None] - both.poses[:2, :, 0, None]).norm(dim=0).argmin(1, keepdim=True)
    assert (both.visibility.gather(1, nearest) == 1).float().mean() > 0.95


def test_drive_is_determined_by_its_seed(both):
    assert torch.equal(simulated_drive("both", seed=5).ranges, both.ranges)
    drives = labelling_drives([0, 1])
    assert [drive.name for drive in drives] == ["left_0", "right_0", "left_1", "right_1"]
    assert [set(drive.thick.tolist()) for drive in drives] == [{False}, {True}] * 2
    assert not torch.equal(drives[0].ranges, drives[2].ranges)
    with pytest.raises(ValueError, match="sides='middle' must be 'left', 'right' or 'both'"):
        simulated_drive("middle", 0)


def test_saved_drive_is_read_back_and_marked_as_simulated(tmp_path):
    drive, path = simulated_drive("left", seed=3), tmp_path / "left.mcap"
    save_drive(drive, path)
    recording = read_recording(path, strict=True)
    assert recording.simulated
    assert np.array_equal(recording.ranges, drive.ranges.numpy())
    np.testing.assert_allclose(recording.angles(0), drive.angles, atol=1e-6)
    np.testing.assert_allclose(recording.seconds, drive.seconds, atol=1e-8)
    np.testing.assert_allclose(recording.poses()[:, :2], drive.poses[:2, :, -1].t(), atol=1e-6)
    assert recording.notes["simulated"]["drive"] == "left_3"
    save_drive(drive, tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == path.read_bytes()
    with pytest.raises(RecordingError, match="lacks the positions of its cones"):
        labelled_drive(recording)


def robots():
    return SimulatedRobotEnv(num_envs=2, time_limit=25 / 5.5, seed=4)


@pytest.fixture(scope="module")
def live():
    """The states and actions of two robots in 25 steps of the guide."""
    return robots().rollout(25, SplineGuide(), break_when_any_done=False)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    paths = [tmp_path_factory.mktemp("drives") / f"{robot}.mcap" for robot in (0, 1)]
    record_drives(robots(), SplineGuide(), paths, {"policy": "spline"})
    return paths


def test_replay_has_the_observations_commands_and_poses_of_the_drive(files, live):
    replay = McapReplayEnv(files, Perception(simulated_cone_classifier()))
    again = replay.rollout(100, SplineGuide())
    assert again.shape == live.shape
    for key in ("cones", "observation", "action"):
        torch.testing.assert_close(again[key], live[key], atol=1e-3, rtol=0)
    assert torch.equal(again["cone_count"], live["cone_count"])
    assert torch.equal(again["info", "valid"], live["info", "valid"])
    for robot, path in enumerate(files):
        commands, _ = read_recording(path).commands
        expected = (live["action"][robot, :, 0] * np.radians(80)).sin() * 0.15 / (2 / 7)
        np.testing.assert_allclose(commands[:, 1], expected, atol=1e-6)
        np.testing.assert_allclose(commands[:, 0], 0.15, atol=1e-6)
    poses = read_recording(files[0]).poses()
    # The robot stands during the first scan; each later one starts at the pose one step before.
    np.testing.assert_allclose(poses[0], live["info", "pose"][0, 0], atol=1e-6)
    np.testing.assert_allclose(poses[1:], live["info", "pose"][0, :-1], atol=1e-6)


def test_recording_ends_with_the_episode_of_its_robot(tmp_path):
    env = SimulatedRobotEnv(num_envs=1)
    record_drives(env, ConstantGuide(1.0), [tmp_path / "crash.mcap"])
    recording = read_recording(tmp_path / "crash.mcap")
    assert 5 < len(recording.log_time) == int(env.steps) < 40
    assert recording.notes["simulated"]["drive"] == "closed loop"


def test_track_is_noted_for_drives_past_both_sides(files, tmp_path):
    for side in ("left", "both"):
        save_drive(simulated_drive(side, seed=3), tmp_path / f"{side}.mcap")
    assert "track" not in read_recording(tmp_path / "left.mcap").notes
    for path in (*files, tmp_path / "both.mcap"):
        assert np.array_equal(track_of(read_recording(path)).left, robot_track().left)


def test_transforms_do_not_change_the_recording(files, tmp_path):
    env = TransformedEnv(robots(), GuideActions({"spline": SplineGuide()}))
    paths = [tmp_path / "0.mcap", tmp_path / "1.mcap"]
    record_drives(env, FollowAdvice(env), paths, {"policy": "spline"})
    for robot, path in enumerate(files):
        assert (tmp_path / f"{robot}.mcap").read_bytes() == path.read_bytes()


def test_invalid_arguments_of_record_drives_are_refused(ring, tmp_path):
    with pytest.raises(ValueError, match="1 paths for 2 robots"):
        record_drives(robots(), SplineGuide(), [tmp_path / "a.mcap"])
    with pytest.raises(ValueError, match="env is a ConeTrackEnv; give a SimulatedRobotEnv"):
        record_drives(ConeTrackEnv([ring]), SplineGuide(), ["a.mcap"])
