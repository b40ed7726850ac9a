"""The simulated robot as an env."""

import math

import pytest
import torch
from ovals import ring_track
from programs import composed
from worlds import driving_measures

import coil_rl.config.schema  # noqa: F401  registers the typed roots
from coil_rl import testing
from coil_rl.config.parts import env_maker
from coil_rl.envs import (
    ConeTrackEnv,
    Perception,
    SimulatedLidar,
    SimulatedRobotEnv,
    Track,
    robot_track,
    shipped_tracks,
)
from coil_rl.envs import simulated_cone_classifier as classifier
from coil_rl.envs.robot.course import THICK, THIN
from coil_rl.guides import ConstantGuide, SplineGuide
from coil_rl.run.evaluation import evaluate_policy
from coil_rl.run.parts import TEST
from coil_rl.transforms import GuideActions

EXACT = SimulatedLidar(noise=0, noise_growth=0, no_return=0, outliers=0)


def robots(count=2, **world):
    return SimulatedRobotEnv(num_envs=count, **world)


def steered(env, actions):
    """The states before and after each of the actions."""
    states = [env.reset()]
    for action in actions:
        given = torch.full((*env.batch_size, 1), action)
        states.append(env.step(states[-1].set("action", given))["next"])
    return states


@pytest.mark.slow
def test_contract_and_entries_are_those_of_the_cone_world():
    robot, world = robots(3), ConeTrackEnv(shipped_tracks("test"), 3)
    testing.check_transform(robot, GuideActions({"spline": SplineGuide()}))
    given, expected = (env.rollout(2, break_when_any_done=False) for env in (robot, world))
    testing.check_guide(SplineGuide(), robots(3))
    keys, known = set(given.keys(True, True)), set(expected.keys(True, True))
    assert known - keys == {"motion", ("next", "motion")}
    for key in known & keys:
        assert given[key].shape == expected[key].shape, key
        assert given[key].dtype == expected[key].dtype, key
    new = keys - known
    assert new == {("info", "valid"), ("next", "info", "valid")}
    assert robot.action_spec == world.action_spec


def test_motion_is_that_of_the_bicycle_model():
    before, after = (state["info", "pose"][0] for state in steered(robots(1, speed=0.15), [0.5]))
    turn = 0.15 / 5.5 / (2 / 7) * math.sin(math.radians(40))
    assert (after[2] - before[2]).item() == pytest.approx(turn, rel=1e-4)
    assert (after[:2] - before[:2]).norm().item() == pytest.approx(0.15 / 5.5, rel=1e-3)


def test_cones_in_view_are_those_of_the_track():
    state = robots(1, lidar=EXACT).reset()
    (left, right), (lefts, rights) = state["cones"][0] / 7, state["cone_count"][0]
    x, y, heading = robot_track().start
    cos, sin = math.cos(heading), math.sin(heading)
    turn = torch.tensor([[cos, -sin], [sin, cos]])
    sides = [(left[:lefts], robot_track().left, THIN), (right[:rights], robot_track().right, THICK)]
    for found, ring, radius in sides:
        centres = (torch.tensor(ring).float() - torch.tensor([x, y])) @ turn
        assert len(found) >= 3
        assert (torch.cdist(found, centres).amin(1) <= radius).all()
    near = robots(1, perception=Perception(classifier(), range_max=0.4)).reset()["cone_count"]
    assert (near < state["cone_count"]).all()


def test_drive_is_determined_by_the_seed():
    first, second, third = (
        steered(robots(2, seed=seed), [0.1, -0.2])[-1]["observation"] for seed in (1, 1, 2)
    )
    assert torch.equal(first, second)
    assert not torch.equal(first, third)


def test_robots_are_independent_but_for_the_noise():
    options, actions = {"lidar": EXACT, "assignment": "cyclic"}, [0.3, -0.1, 0.2]
    tracks = [robot_track(), ring_track("ring", 0.6, 0.4)]
    alone = steered(robots(1, **options), actions)[-1]
    together = steered(robots(3, tracks=tracks, **options), actions)[-1]
    for key in ("observation", ("info", "clearance")):
        for car in (0, 2):
            torch.testing.assert_close(alone[key][0], together[key][car])


def test_state_dict_is_the_whole_state():
    first, second = robots(2, seed=1), robots(2, seed=9)
    state = steered(first, [0.2] * 3)[-1]
    second.load_state_dict(first.state_dict())
    one, other = (
        env.step(state.clone().set("action", torch.zeros(2, 1)))["next"] for env in (first, second)
    )
    for key, value in one.items(True, True):
        assert torch.equal(value, other[key]), key
    assert torch.equal(first.scan, second.scan)


@pytest.mark.parametrize("action", [1.0, 0.0])
def test_constant_steering_crashes(action):
    episodes = evaluate_policy(
        robots(2), ConstantGuide(action), measures=driving_measures("simulated_robot")
    ).episodes
    assert all(episode["crashed"] and not episode["completed"] for episode in episodes)
    assert all(-0.03 < episode["clearance"] <= 0 for episode in episodes)
    assert all(episode["reward"] < -90 for episode in episodes)


def test_episode_is_truncated_at_the_time_limit():
    states = steered(robots(1, time_limit=1.0), [0.0] * 6)
    # 5.5 steps, rounded to the even number.
    assert [bool(state["truncated"]) for state in states[1:]] == [False] * 5 + [True]
    assert not states[-1]["terminated"].any()


@pytest.mark.slow
def test_guide_completes_its_laps_on_tracks_of_both_directions():
    track = robot_track()
    mirrored = Track("mirrored", left=track.right * [1, -1], right=track.left * [1, -1])
    env = robots(2, tracks=[track, mirrored], assignment="cyclic", laps=1)
    result = evaluate_policy(
        env,
        SplineGuide(),
        measures=driving_measures("simulated_robot"),
        record={"pose": ("info", "pose")},
        cases=["one", "other"],
    )
    assert [episode["case"] for episode in result.episodes] == ["one", "other"]
    assert all(episode["completed"] and not episode["crashed"] for episode in result.episodes)
    # A lap of 6 m takes 40 s at 0.15 m/s, a little less with cut corners.
    assert all(36 < episode["lap_time"] < 42 for episode in result.episodes)
    one, other = result.histories["pose"]
    assert one[:, 1].mean() > 0.3 > -0.3 > other[:, 1].mean()
    env = robots(64, tracks=[track, mirrored])
    first, second = (env.reset()["info", "track"] for _ in range(2))
    assert 15 < first.sum() < 49
    assert not torch.equal(first, second)


def test_no_tracks_are_refused():
    with pytest.raises(ValueError, match="tracks is empty"):
        SimulatedRobotEnv(tracks=[])


def test_configuration_agrees_with_the_defaults():
    words = ["env=simulated_robot", "track=robot", "budget.num_envs=2", "run_dir=unused"]
    config = composed(*words, name="evaluate")
    env = env_maker(config)(3, TEST).base_env
    assert isinstance(env, SimulatedRobotEnv)
    plain = SimulatedRobotEnv(num_envs=3, assignment="cyclic")
    for one, other in ((env, plain), (env.perception, plain.perception), (env.lidar, plain.lidar)):
        numbers = {k: v for k, v in vars(other).items() if isinstance(v, (int, float))}
        assert {name: vars(one)[name] for name in numbers} == pytest.approx(numbers, rel=1e-5)
    assert torch.equal(env.weights, plain.weights)


def test_robots_that_are_not_reset_keep_what_they_saw():
    def driven(forget):
        env = SimulatedRobotEnv(num_envs=16, starts=16, time_limit=2.0, assignment="cyclic")
        torch.manual_seed(0)
        state, rows = env.reset(), []
        for _ in range(20):
            step, state = env.step_and_maybe_reset(env.rand_action(state))
            rows.append(step)
            if forget:  # all scans are perceived anew
                env.load_state_dict(env.state_dict())
        return rows

    for one, other in zip(driven(False), driven(True), strict=True):
        assert (one == other).all()
