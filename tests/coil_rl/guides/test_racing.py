import math

import numpy as np
import pytest
import torch

from coil_rl.envs import ConeTrackEnv, random_tracks, shipped_tracks
from coil_rl.guides import RacingGuide, SplineGuide
from coil_rl.testing import check_guide
from coil_rl.train.evaluation import evaluate_policy

# Two midpoints, (2, 0.5) and (3, 0.5), and with a spacing of 1 m just these targets.
TWO_TARGETS = ([(2.0, 2.0)], [(2.0, -1.0), (4.0, -1.0)])
KEYS = ("cones", "cone_count", "steering")


@pytest.fixture(scope="module")
def seen():
    """What twenty cars see that drive badly, 40 steps each: [800]."""
    env = ConeTrackEnv(random_tracks(count=2, seed=4), 20)
    wild = RacingGuide(turn=2.0, margin=0.3)
    steps = env.rollout(40, wild, break_when_any_done=False).select(*KEYS).reshape(-1)
    steps["steering"] = torch.linspace(-1, 1, len(steps)).unsqueeze(-1)
    return steps


def advice(left, right, steering=0.0, **kwargs):
    cones = torch.zeros(1, 2, 16, 2, dtype=torch.float64)
    for side, points in enumerate((left, right)):
        for slot, point in enumerate(sorted(points, key=lambda p: math.hypot(*p))):
            cones[0, side, slot] = torch.tensor(point)
    count = torch.tensor([[len(left), len(right)]])
    return RacingGuide(spacing=1.0, **kwargs).steer(cones, count, torch.full((1, 1), steering).double()).item()


def arc(x, y, turn=1.4):
    """The steering that holds `turn` times the curvature 2 sin(alpha) / d of the arc to (x, y), for a car of 2 m."""
    return math.asin(2 * turn * 2 * y / (x * x + y * y)) / math.radians(80)


def lap(track, guide, rate=24.0):
    return evaluate_policy(ConeTrackEnv([track], 1, rate=rate, laps=1), guide).episodes[0]


def test_arc_to_the_farthest_target_that_is_clear_is_driven():
    assert arc(3, 0.5) == pytest.approx(0.22025, abs=1e-5)
    assert advice(*TWO_TARGETS) == pytest.approx(arc(3, 0.5), abs=1e-9)
    assert advice(*TWO_TARGETS, turn=1) == pytest.approx(arc(3, 0.5, turn=1), abs=1e-9)


def test_nearer_target_is_taken_where_a_cone_or_the_lookahead_bars_the_farther_one():
    assert advice(*TWO_TARGETS, lookahead=3.0) == pytest.approx(arc(2, 0.5), abs=1e-9)
    # The cone nearest to the arc that leads to (3, 0.5) is (2, -1), at 1.193 m.
    assert advice(*TWO_TARGETS, turn=1, margin=1.19) == pytest.approx(arc(3, 0.5, turn=1), abs=1e-9)
    assert advice(*TWO_TARGETS, turn=1, margin=1.2) == pytest.approx(arc(2, 0.5, turn=1), abs=1e-9)


@pytest.mark.parametrize("margin", [0.0, 0.6, 1.9])
def test_a_target_that_is_the_only_one_is_steered_for_whether_or_not_it_is_clear(margin):
    # Midpoints (0.5, 0), which is reached, and (1.5, 0.5).
    assert advice([(0.5, 1.0)], [(0.5, -1.0), (2.5, 0.0)], margin=margin, turn=1) == pytest.approx(arc(1.5, 0.5, 1))


def test_steering_is_kept_without_a_target_and_full_where_the_arc_is_too_sharp():
    assert advice([], [], 0.3) == pytest.approx(0.3)
    assert advice([(2.0, 1.0), (4.0, 1.0)], [], -0.7) == pytest.approx(-0.7)
    assert advice([(0.5, 1.0)], [(0.5, -1.0), (2.5, 0.0)], turn=3.0) == pytest.approx(1)


def test_an_arc_is_clear_if_each_cone_is_on_its_side_and_no_nearer_than_the_margin(seen):
    guide, draw = RacingGuide(margin=0.5), np.random.default_rng(3)
    some, count = seen["cones"][::10].double(), seen["cone_count"][::10]
    curvature = draw.uniform(-0.49, 0.49, (6, len(some)))
    curvature[0], distance = 0, draw.uniform(1, 8, curvature.shape)
    ours = 1 - guide._barred(*(torch.from_numpy(x) for x in (curvature, distance)), some, count)
    assert 0.05 < ours.mean() < 0.95
    for (target, row), clear in np.ndenumerate(ours.numpy()):
        k, reach = curvature[target, row], distance[target, row]
        free = reach <= 7
        for side, sign in enumerate((1, -1)):
            x, y = some[row, side, : count[row, side]].numpy().T
            # To the left of a circle that is driven anticlockwise is its inside.
            left = y if k == 0 else (1 / abs(k) - np.hypot(x, y - 1 / k)) * np.sign(k)
            free &= bool((sign * left >= 0.5)[np.hypot(x, y) <= reach + 0.5].all())
        assert clear == free


def test_guide_keeps_the_contract_for_each_car_by_itself(seen):
    check_guide(RacingGuide(), seen[::7])
    check_guide(RacingGuide(spline="quadratic"), seen[::31])


def test_advice_is_an_action_and_differs_from_the_safety_policys(seen):
    action = RacingGuide()(seen.clone())["action"]
    assert action.abs().max() <= 1
    assert (action != SplineGuide()(seen.clone())["action"]).float().mean() > 0.9


def test_a_mirrored_road_is_steered_the_other_way(seen):
    cones, count, steering = (seen[key] for key in KEYS)
    guide, mirror = RacingGuide().steer, torch.tensor([1.0, -1.0], dtype=torch.float64)
    mirrored = guide(cones.double().flip(1) * mirror, count.flip(1), -steering.double())
    torch.testing.assert_close(mirrored, -guide(cones.double(), count, steering.double()), rtol=0, atol=1e-9)


def test_what_lies_in_the_padding_has_no_influence(seen):
    cones, count, steering = (seen[key] for key in KEYS)
    padding = torch.arange(cones.shape[2]) >= count.unsqueeze(-1)
    other = torch.where(padding.unsqueeze(-1), torch.full_like(cones, 1.5), cones)
    assert torch.equal(RacingGuide().steer(other, count, steering), RacingGuide().steer(cones, count, steering))


def test_a_corner_is_cut(ring):
    racing, safe = lap(ring, RacingGuide(), rate=12), lap(ring, SplineGuide(), rate=12)
    assert racing["completed"]
    assert racing["lap_time"] < safe["lap_time"] - 0.3
    assert 0 < racing["clearance"] < safe["clearance"]


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 5])
def test_a_lap_of_a_shipped_track_is_shorter_smoother_and_without_a_crash(number):
    track = shipped_tracks("train")[number]
    racing, safe = lap(track, RacingGuide()), lap(track, SplineGuide())
    assert racing["completed"]
    assert racing["lap_time"] < safe["lap_time"]
    assert racing["smoothness"] < safe["smoothness"] / 3
    assert racing["reward"] > safe["reward"]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [("margin", -0.1, "at least 0"), ("margin", 2.0, "less than car_length=2.0"),
     ("turn", 0, "more than 0"), ("lookahead", math.inf, "more than 0"),
     ("spacing", 0, "more than 0"), ("car_length", math.nan, "more than 0"), ("max_steering", 100, "at most 90"),
     ("targets", 1, "at least 2")],
)  # fmt: skip
def test_a_value_outside_its_range_is_named(name, value, message):
    with pytest.raises(ValueError, match=f"{name}={value} .*{message}"):
        RacingGuide(**{name: value})
