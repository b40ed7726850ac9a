import math

import pytest
import torch

from coil_rl.envs import ConeTrackEnv, DrivingTasksEnv, Track, random_tracks
from coil_rl.guides import ConstantGuide, SplineGuide
from coil_rl.learners.networks import actor
from coil_rl.train.evaluation import evaluate_policy, summarise

TRACKS = random_tracks(2, seed=5)


def test_measures_of_a_guide_that_completes_its_laps(ring):
    tracks = [ring, Track("wider", 1.1 * ring.left, 1.1 * ring.right)]
    env = ConeTrackEnv(tracks, 2, assignment="cyclic", laps=1, rate=8)
    result = evaluate_policy(env, SplineGuide(), names=[track.name for track in tracks])
    for track, row, line in zip(tracks, result.episodes, result.lines, strict=True):
        assert (row["track"], row["completed"], row["crashed"], row["laps"]) == (track.name, True, False, 1)
        assert row["clearance"] > 0
        # The middle line at 2 m/s; the guide cuts corners.
        assert row["lap_time"] == pytest.approx(track.length / 2, rel=0.05)
        assert len(line) == row["steps"] >= row["lap_time"] * 8
    again = evaluate_policy(env, SplineGuide(), names=[track.name for track in tracks])
    assert again.episodes == result.episodes


def test_measures_of_a_crash():
    env = ConeTrackEnv(TRACKS, 4, assignment="cyclic")
    result = evaluate_policy(env, ConstantGuide(1.0))
    for row in result.episodes:
        assert (row["crashed"], row["completed"]) == (True, False)
        assert math.isnan(row["lap_time"])
        assert row["clearance"] <= 0
        assert -100 < row["reward"] < -80


def test_sampled_actions_are_less_smooth_than_deterministic_ones():
    env = ConeTrackEnv(TRACKS, 2, assignment="cyclic", rate=8)
    policy = actor(env, ["observation"])
    plain, drawn = (
        evaluate_policy(env, policy, sampled=sampled).episodes[0]["smoothness"] for sampled in (False, True)
    )
    assert drawn > 10 * plain
    mixed = evaluate_policy(env, policy, sampled=torch.tensor([False, True])).episodes
    assert mixed[0]["smoothness"] == pytest.approx(plain, rel=0.01)
    assert mixed[1]["smoothness"] > 10 * plain


def test_summary_is_the_mean_over_tracks_of_means_over_episodes():
    def episode(track, reward, lap_time, crashed):
        return {
            "track": track, "reward": reward, "lap_time": lap_time, "smoothness": 0.1, "completed": not crashed,
            "crashed": crashed, "clearance": reward / 100,
        }  # fmt: skip

    rows = summarise([episode("a", 10, 5.0, False), episode("a", 20, math.nan, True), episode("b", 40, math.nan, True)])
    assert [row["track"] for row in rows] == ["a", "b", "mean"]
    assert [row["reward"] for row in rows] == [15, 40, 27.5]
    assert rows[0]["lap_time"] == rows[2]["lap_time"] == 5
    assert math.isnan(rows[1]["lap_time"])
    assert [row["crashed"] for row in rows] == [0.5, 1, 0.75]
    assert rows[2]["clearance"] == 0.1


def test_reward_of_each_task_is_measured():
    tasks = {"left": {"alive": 1.0, "crash": 0.0, "cone": 0.0}, "right": {"alive": -1.0, "crash": 0.0, "cone": 0.0}}
    env = DrivingTasksEnv(TRACKS, 6, assignment="cyclic", tasks=tasks, duration=0.5, reward={"smooth": 0.0})
    result = evaluate_policy(env, ConstantGuide(1.0))
    for row in result.episodes:
        assert row["steps_left"] + row["steps_right"] == row["steps"]
        assert row["reward_left"] + row["reward_right"] == pytest.approx(row["reward"])
    assert sum(row["steps_left"] for row in result.episodes) > 6
    *rows, mean = summarise(result.episodes)
    for row in rows:
        alike = [episode for episode in result.episodes if episode["track"] == row["track"]]
        steps, paid = (sum(episode[f"{what}_left"] for episode in alike) for what in ("steps", "reward"))
        assert row["per_step_left"] == pytest.approx(paid / steps)
        # Every step but that of the crash.
        assert 0.8 < row["per_step_left"] <= 1
    assert mean["per_step_left"] == pytest.approx(sum(row["per_step_left"] for row in rows) / 2)
    env = DrivingTasksEnv(TRACKS, 2, assignment="cyclic", tasks={"left": {}, "right": {}}, only="left")
    *_, mean = summarise(evaluate_policy(env, ConstantGuide(1.0)).episodes)
    assert math.isnan(mean["per_step_right"]), "there are no steps of the task"
