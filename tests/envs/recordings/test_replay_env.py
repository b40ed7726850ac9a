"""Replay of recordings as an env."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from drives import blind, drive
from omegaconf import OmegaConf

from coil_rl import compose_train
from coil_rl.config.nodes import build
from coil_rl.envs import (
    McapReplayEnv,
    Perception,
    SimulatedRobotEnv,
    read_recording,
    record_drives,
    save_drive,
    simulated_cone_classifier,
    simulated_drive,
)
from coil_rl.envs.robot.perception import BoundaryMemory
from coil_rl.guides import SplineGuide
from coil_rl.testing import check_env, check_transform
from coil_rl.transforms import GuideActions


def scripted(ranges, angles):
    """Perception of cones whose distance depends on the first range of a scan."""
    number = np.nan_to_num(ranges[:, 0], posinf=1.0).reshape(-1, 1, 1)
    ahead = 1.5 + np.arange(4) + 0.1 * number
    side = np.array([2.0, -2.0]).reshape(2, 1)
    cones = np.zeros((len(ranges), 2, 4, 2))
    cones[..., 0], cones[..., 1] = ahead, np.broadcast_to(side, (len(ranges), 2, 4))
    return cones, np.full((len(ranges), 2), 4)


def test_env_contract_holds(tmp_path):
    paths = [drive(tmp_path / "a.mcap", 7), drive(tmp_path / "b.mcap", 3, commands=True)]
    env = McapReplayEnv(paths, scripted)
    assert env.batch_size == (2,)
    check_env(env)
    check_transform(env, GuideActions({"spline": SplineGuide()}))


def test_length_of_a_recording_is_that_of_the_file_as_it_is_now(tmp_path, monkeypatch):
    for folder, scans in {"one": 3, "two": 7}.items():
        (tmp_path / folder).mkdir()
        monkeypatch.chdir(tmp_path / folder)
        drive(Path("a.mcap"), scans)
        assert McapReplayEnv.whole_pass({"recordings": "a.mcap"}) == (1, scans)
    drive(Path("a.mcap"), 5)
    assert McapReplayEnv.whole_pass({"recordings": "a.mcap"}) == (1, 5)


@pytest.mark.slow
@torch.no_grad()
def test_ten_unreadable_scans_keep_the_last_observation_and_action(tmp_path):
    save_drive(simulated_drive("both", seed=0), tmp_path / "a.mcap")
    recording = read_recording(tmp_path / "a.mcap")
    perception = Perception(simulated_cone_classifier())
    steps = McapReplayEnv(recording, perception).rollout(80, SplineGuide())[0]
    valid = steps["info", "valid"].all(-1)
    last = 20 + int(valid[20:].nonzero()[0])
    gap = slice(last + 1, last + 11)
    unreadable = recording.ranges.copy()
    unreadable[gap] = np.nan
    env = McapReplayEnv(replace(recording, ranges=unreadable), perception)
    steps = env.rollout(80, SplineGuide())[0]
    assert not steps["info", "valid"][gap].any()
    for key in ("observation", "action"):
        assert torch.equal(steps[key][gap], steps[key][last].expand(10, -1))
        assert not torch.equal(steps[key][-1], steps[key][last])


def test_each_recording_ends_after_one_action_per_scan_and_restarts(tmp_path):
    paths = [drive(tmp_path / f"{scans}.mcap", scans, seed=scans) for scans in (7, 3)]
    env = McapReplayEnv(paths, scripted)
    rollout = env.rollout(7, break_when_any_done=False)
    scans = rollout["info", "scan"].squeeze(-1).tolist()
    assert scans == [[0, 1, 2, 3, 4, 5, 6], [0, 1, 2, 0, 1, 2, 0]]
    ends = rollout["next", "truncated"].squeeze(-1).int().tolist()
    assert ends == [[0, 0, 0, 0, 0, 0, 1], [0, 0, 1, 0, 0, 1, 0]]
    assert torch.equal(rollout["next", "done"], rollout["next", "truncated"])
    assert not rollout["next", "terminated"].any()
    assert rollout["next", "info", "scan"][1].squeeze(-1).tolist() == [1, 2, 2, 1, 2, 2, 1]
    assert rollout["info", "time"][0, 3].item() == pytest.approx(3 * 0.182)
    for row, path in enumerate(paths):
        alone = McapReplayEnv(path, scripted).rollout(7, break_when_any_done=False)
        for key in ("observation", "cones", ("next", "done"), ("info", "scan")):
            assert torch.equal(alone[key][0], rollout[key][row])


def test_omega_follows_from_the_steering_and_the_robot(tmp_path):
    path = drive(tmp_path / "a.mcap", 9)
    env = McapReplayEnv(path, blind, speed=0.2, car_length=0.25, smooth=-2.0)
    state = env.reset()
    assert state["omega"].item() == 0
    state = env.step(state.set("action", torch.tensor([[0.5]])))["next"]
    assert state["steering"].item() == 0.5
    assert state["omega"].item() == pytest.approx(0.2 / 0.25 * math.sin(math.radians(40)))
    assert state["reward"].item() == pytest.approx(-2.0 * 0.5)
    state = env.step(state.clone().set("action", torch.tensor([[3.0]])))["next"]
    assert state["omega"].item() == pytest.approx(0.2 / 0.25 * math.sin(math.radians(80)))


def test_pose_is_relative_to_the_first_scan(tmp_path):
    path = drive(tmp_path / "a.mcap", 40, odometry=True)
    pose = McapReplayEnv(path, blind).rollout(40)["info", "pose"][0]
    angle = 0.15 * 0.182 * torch.arange(40)
    expected = torch.stack([angle.sin(), 1 - angle.cos(), angle], 1)
    torch.testing.assert_close(pose, expected, rtol=0, atol=1e-6)
    recording = read_recording(path)
    poses, log_time, stamp = recording.odometry
    turned = np.stack([100 - poses[:, 1], poses[:, 0] - 50, poses[:, 2] + np.pi / 2], axis=1)
    moved = McapReplayEnv(replace(recording, odometry=(turned, log_time, stamp)), blind)
    torch.testing.assert_close(moved.rollout(40)["info", "pose"][0], pose, rtol=0, atol=1e-5)


def test_state_dict_is_the_whole_state(tmp_path):
    first, second = (McapReplayEnv(drive(tmp_path / "a.mcap", 20), scripted) for _ in range(2))

    def steer(tensordict):
        return tensordict.set("action", tensordict["observation"][:, :1])

    state = first.rollout(8, steer)[:, -1]["next"]
    second.load_state_dict(first.state_dict())
    expected, resumed = (
        env.rollout(5, steer, auto_reset=False, tensordict=state.clone()) for env in (first, second)
    )
    assert (expected == resumed).all()
    assert resumed["info", "scan"].squeeze().tolist() == [8, 9, 10, 11, 12]


def test_perception_is_called_once_for_all_scans_with_equal_bearings(tmp_path):
    calls = []

    def counting(ranges, angles):
        calls.append((ranges.shape, angles.shape))
        return blind(ranges, angles)

    recording = read_recording(drive(tmp_path / "a.mcap", 9))
    McapReplayEnv(recording, counting).rollout(9)
    assert calls == [((9, 360), (360,))]
    points = recording.points.copy()
    points[4] = 300
    McapReplayEnv(replace(recording, points=points), counting)
    assert calls[1:] == [((1, 300), (300,)), ((8, 360), (360,))]


def test_cones_are_padded_or_cut_to_the_nearest(tmp_path):
    path = drive(tmp_path / "a.mcap", 3)
    many, few = (McapReplayEnv(path, scripted, kept_cones=kept).reset() for kept in (6, 3))
    assert (many["cones"].shape, few["cones"].shape) == ((1, 2, 6, 2), (1, 2, 3, 2))
    assert many["cone_count"].tolist() == [[4, 4]]
    assert few["cone_count"].tolist() == [[3, 3]]
    assert torch.equal(many["cones"][:, :, :3], few["cones"])
    assert not many["cones"][:, :, 4:].any()


def test_invalid_arguments_are_refused(tmp_path):
    def short(ranges, angles):
        return blind(ranges[:1], angles)

    path = drive(tmp_path / "a.mcap", 3)
    with pytest.raises(ValueError, match=r"must return \[3, 2, K, 2\]"):
        McapReplayEnv(path, short)
    with pytest.raises(ValueError, match="at most 90"):
        McapReplayEnv(path, blind, max_steering=91.0)


@pytest.mark.parametrize(("range_max", "scale"), [(1.0, 7.0), (1.6, 5.625)])
def test_observation_is_that_of_a_robot_with_the_same_perception(tmp_path, range_max, scale):
    perception = Perception(simulated_cone_classifier(), range_max=range_max, scale=scale)
    robot = SimulatedRobotEnv(perception=perception, time_limit=4.0)
    record_drives(robot, SplineGuide(), [tmp_path / "a.mcap"])
    seen = read_recording(tmp_path / "a.mcap")
    env = McapReplayEnv(seen, perception)
    assert env.memory.sight == robot.memory.sight == range_max * scale
    observation = env.rollout(len(seen.ranges), SplineGuide())["observation"][0]
    memory = BoundaryMemory(1, sight=perception.sight)
    for scan, expected in zip(seen.ranges, observation, strict=True):
        cones, count = perception(scan[None], seen.angles(0))
        own, _ = memory(torch.from_numpy(cones).float(), torch.from_numpy(count))
        torch.testing.assert_close(own[0], expected, rtol=0, atol=1e-6)


def test_configuration_builds_the_env(tmp_path):
    words = [f"recording=[{drive(tmp_path / 'a.mcap', 3)}]", "method=oil", "env=mcap_replay"]
    config = compose_train([*words, "run_dir=unused"])
    assert (config.budget.num_envs, config.budget.steps, config.budget.frames) == (1, 3, 3)
    node = OmegaConf.to_container(config.env, resolve=True)
    del node["perception"]
    assert build(node, "env", McapReplayEnv, perception=blind).rollout(9).shape == (1, 3)


def test_recorded_steering_is_usable_once(tmp_path):
    paths = [drive(tmp_path / f"{scans}.mcap", scans, commands=True) for scans in (4, 6)]
    env = McapReplayEnv(paths, blind, num_envs=3)
    steps = env.rollout(8, break_when_any_done=False)
    steering = math.asin(0.15 * (2 / 7) / 0.15) / math.radians(80)
    torch.testing.assert_close(steps["info", "recorded"], torch.full((3, 8, 1), steering))
    # The short recording begins anew after four scans, and the third row repeats the first one.
    usable = steps["info", "usable"].squeeze(-1)
    assert usable.sum(1).tolist() == [4, 6, 0]
    assert steps["info", "track"][:, 0, 0].tolist() == [0, 1, 0]
    assert not steps["info", "stale"].any()


def test_scans_without_commands_are_stale_and_those_of_a_standing_robot_are_marked(tmp_path):
    path = drive(tmp_path / "a.mcap", 5, commands=True)
    recording = read_recording(path)
    commands, times = recording.commands
    commands[2:, 0] = 0.0
    standing = McapReplayEnv(replace(recording, commands=(commands, times)), blind).rollout(5)
    assert standing["info", "standing"].flatten().tolist() == [False, False, True, True, True]
    silent = McapReplayEnv(drive(tmp_path / "b.mcap", 5), blind).rollout(5)
    assert silent["info", "stale"].all()
    assert not silent["info", "usable"].any()
    assert not silent["info", "recorded"].any()
