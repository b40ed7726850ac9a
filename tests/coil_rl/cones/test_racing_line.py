import math

import numpy as np
import pytest
import torch
from worlds import driving_measures, road

from coil_rl.envs import ConeTrackEnv, random_tracks, shipped_tracks
from coil_rl.guides import RacingLineGuide, SplineGuide
from coil_rl.run.evaluation import evaluate_policy
from coil_rl.testing import check_guide

# Midpoints (2, 0.5) and (3, 0.5); with a spacing of 1 m these are the targets.
TWO_TARGETS = ([(2.0, 2.0)], [(2.0, -1.0), (4.0, -1.0)])
# Midpoints (0.5, 0), which is reached, and (1.5, 0.5).
ONE_TARGET = ([(0.5, 1.0)], [(0.5, -1.0), (2.5, 0.0)])
KEYS = ("cones", "cone_count", "steering")


@pytest.fixture(scope="module")
def steps():
    """Steps of twenty cars with a poor guide: [800]."""
    env = ConeTrackEnv(random_tracks(count=2, seed=4), 20)
    poor = RacingLineGuide(turn=2.0, margin=0.3)
    steps = env.rollout(40, poor, break_when_any_done=False).select(*KEYS).reshape(-1)
    steps["steering"] = torch.linspace(-1, 1, len(steps)).unsqueeze(-1)
    return steps


def advice(left, right, steering=0.0, **kwargs):
    guide = RacingLineGuide(spacing=1.0, **kwargs)
    return guide.steer(*road(left, right, steering)).item()


def arc(x, y, turn=1.4):
    """Steering for `turn` times the curvature 2 sin(alpha) / d of the arc, for a car of 2 m."""
    return math.asin(2 * turn * 2 * y / (x * x + y * y)) / math.radians(80)


def lap(track, guide):
    env = ConeTrackEnv([track], 1, rate=24.0, laps=1)
    return evaluate_policy(env, guide, measures=driving_measures()).episodes[0]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, arc(3, 0.5)),
        ({"turn": 1}, arc(3, 0.5, turn=1)),
        ({"lookahead": 3.0}, arc(2, 0.5)),
        # The cone nearest to the arc to (3, 0.5) is (2, -1), at 1.193 m.
        ({"turn": 1, "margin": 1.19}, arc(3, 0.5, turn=1)),
        ({"turn": 1, "margin": 1.2}, arc(2, 0.5, turn=1)),
    ],
)
def test_target_is_the_farthest_with_a_clear_arc_within_the_lookahead(options, expected):
    assert arc(3, 0.5) == pytest.approx(0.22025, abs=1e-5)
    assert advice(*TWO_TARGETS, **options) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("margin", [0.0, 0.6, 1.9])
def test_without_a_clear_arc_the_target_is_the_nearest(margin):
    assert advice(*ONE_TARGET, margin=margin, turn=1) == pytest.approx(arc(1.5, 0.5, 1))
    assert advice(*ONE_TARGET, margin=margin, turn=3) == pytest.approx(1), "it is clamped"


def test_without_a_target_the_racing_line_keeps_the_steering():
    assert advice([(2.0, 1.0), (4.0, 1.0)], [], -0.7) == pytest.approx(-0.7)


@pytest.mark.slow
def test_blocked_arcs_agree_with_geometry(steps):
    check_guide(RacingLineGuide(), ConeTrackEnv(random_tracks(count=2, seed=4), 3))
    guide, draw = RacingLineGuide(margin=0.5), np.random.default_rng(3)
    cones, count = steps["cones"][::30].double(), steps["cone_count"][::30]
    curvature = draw.uniform(-0.49, 0.49, (6, len(cones)))
    curvature[0], distance = 0, draw.uniform(1, 8, curvature.shape)
    clear = 1 - guide._blocked(*(torch.from_numpy(x) for x in (curvature, distance)), cones, count)
    assert 0.05 < clear.mean() < 0.95
    for (target, row), found in np.ndenumerate(clear.numpy()):
        k, reach = curvature[target, row], distance[target, row]
        expected = reach <= 7
        for side, sign in enumerate((1, -1)):
            x, y = cones[row, side, : count[row, side]].numpy().T
            # Left of a circle driven anticlockwise is its inside.
            left = y if k == 0 else (1 / abs(k) - np.hypot(x, y - 1 / k)) * np.sign(k)
            expected &= bool((sign * left >= 0.5)[np.hypot(x, y) <= reach + 0.5].all())
        assert found == expected


@pytest.mark.slow
def test_laps_are_shorter_and_smoother_and_nearer_to_the_cones():
    track = shipped_tracks("train")[5]
    racing, safe = (lap(track, guide) for guide in (RacingLineGuide(), SplineGuide()))
    assert racing["completed"]
    assert racing["lap_time"] < safe["lap_time"] - 0.3
    assert 0 < racing["clearance"] < safe["clearance"]
    assert racing["smoothness"] < safe["smoothness"] / 3
