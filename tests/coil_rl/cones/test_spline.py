"""The spline guide, and properties that it shares with the racing line guide."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracle import guide_action
from worlds import road

from coil_rl.guides import RacingLineGuide, SplineGuide, SplineMemoryGuide

SLOTS = 16
both_splines = pytest.mark.parametrize("spline", ["cubic", "quadratic"])
every_guide = pytest.mark.parametrize(
    "guide",
    [SplineGuide(), SplineGuide("quadratic"), RacingLineGuide()],
    ids=["cubic", "quadratic", "racing line"],
)


def advice(left, right, steering=0.0, **kwargs):
    return SplineGuide(**kwargs).steer(*road(left, right, steering)).item()


def roads(seed, cars, dtype=torch.float64):
    """Bends of random curvature from random poses, with zero to five cones a side."""
    draw = torch.Generator().manual_seed(seed)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(cars, *shape, dtype=torch.float64, generator=draw)

    along = torch.arange(SLOTS) * uniform(1, 2, 2, 1) + uniform(0.3, 1.5, 2, 1)
    side = torch.tensor([1.2, -1.2], dtype=torch.float64).view(1, 2, 1)
    side = side + uniform(-0.4, 0.4, 2, SLOTS)
    y = side + uniform(-0.3, 0.3, 1, 1) * along**2 + uniform(-0.5, 0.5, 1, 1)
    cones = torch.stack([along, y], dim=-1)
    order = cones.square().sum(-1).argsort(dim=-1).unsqueeze(-1).expand_as(cones)
    count = torch.randint(0, 6, (cars, 2), generator=draw)
    return cones.gather(2, order).to(dtype), count, uniform(-1, 1, 1).to(dtype)


def equation_103(x, y, sharpness=1.8):
    alpha, distance = math.degrees(math.atan2(y, x)), math.hypot(x, y)
    return 160 / math.pi * math.atan(alpha / distance**sharpness) / 80


# Midpoints (2, 0.5) and (3, 0.5): a straight path with these two targets.
TWO_MIDPOINTS = ([(2.0, 2.0)], [(2.0, -1.0), (4.0, -1.0)])


@both_splines
@pytest.mark.parametrize(
    ("left", "right", "target"),
    [
        (*TWO_MIDPOINTS, (2, 0.5)),
        # Midpoint (0.5, 0) is within 0.625 m.
        ([(0.5, 1.0)], [(0.5, -1.0), (2.5, 0.0)], (1.5, 0.5)),
        # Midpoint (0.25, 0.9) is at 74 degrees.
        ([(0.5, 1.9)], [(0.0, -0.1), (2.0, -0.1)], (1.25, 0.9)),
    ],
    ids=["nearest", "reached", "to the side"],
)
def test_advice_is_equation_103_of_the_nearest_eligible_target(left, right, target, spline):
    assert equation_103(2, 0.5) == pytest.approx(0.83687, abs=1e-5)
    assert advice(left, right, spline=spline) == pytest.approx(equation_103(*target), abs=1e-12)


def test_parameters_of_equation_103():
    default, flat = equation_103(2, 0.5), equation_103(2, 0.5, sharpness=1)
    assert advice(*TWO_MIDPOINTS, sharpness=1) == pytest.approx(flat, abs=1e-12)
    assert advice(*TWO_MIDPOINTS, gain=0.5) == pytest.approx(default / 2, abs=1e-12)
    assert advice([], [], steering=0.3, gain=0.5) == 0.3
    assert advice(*TWO_MIDPOINTS, max_steering=40) == pytest.approx(default, abs=1e-12)


@every_guide
def test_advice_is_antisymmetric_and_independent_of_padding(guide):
    cones, count, steering = roads(7, cars=1000)
    action = guide.steer(cones, count, steering)
    mirrored = cones.flip(1) * torch.tensor([1.0, -1.0])
    opposite = guide.steer(mirrored, count.flip(1), -steering)
    assert torch.allclose(opposite, -action, rtol=0, atol=1e-9)
    padding = torch.arange(SLOTS) >= count.unsqueeze(-1)
    shuffled = torch.where(padding.unsqueeze(-1), cones.flip(2) - 3, cones)
    assert torch.equal(guide.steer(shuffled, count, steering), action)
    assert torch.equal(guide.steer(cones[:, :, :6], count, steering), action)


@both_splines
def test_advice_equals_the_oracle(spline):
    cones, count, steering = roads(8, cars=300)
    ours = SplineGuide(spline).steer(cones, count, steering)
    for car in range(300):
        left, right = (cones[car, side, : count[car, side]].numpy() for side in range(2))
        expected = guide_action(left, right, steering[car].item(), spline=spline)
        assert ours[car].item() == pytest.approx(expected, abs=1e-6)


@every_guide
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_advice_is_batch_invariant(guide, dtype):
    batch = roads(9, cars=1003, dtype=dtype)
    together = guide.steer(*batch)
    for car in range(0, 1003, 33):
        alone = guide.steer(*(value[car : car + 1] for value in batch))
        assert torch.equal(alone, together[car : car + 1])


coordinates = st.sampled_from([0.0, 1.0, 1.0 + 1e-7, -1.0, 2.0, 5.0]) | st.floats(-7, 7, width=32)
points = st.lists(st.tuples(coordinates, coordinates), max_size=SLOTS)


@pytest.mark.slow
@every_guide
@given(left=points, right=points, duplicated=st.booleans(), steering=st.floats(-1, 1, width=32))
def test_advice_is_an_action_for_any_cones(guide, left, right, duplicated, steering):
    if duplicated:
        left, right = (left + left)[:SLOTS], (right + left)[:SLOTS]
    cones, count, current = road(left, right, steering)
    for dtype in (torch.float32, torch.float64):
        action = guide.steer(cones.to(dtype), count, current.to(dtype))
        assert (action.shape, action.dtype) == ((1, 1), dtype)
        assert action.abs() <= 1


SPLINE = {"spline": "linear", "smoothing": -1, "sharpness": math.nan, "max_steering": 0}
RACING = {"margin": -0.1, "turn": 0, "lookahead": math.inf, "spacing": 0, "car_length": math.nan}


@pytest.mark.parametrize(
    ("guide", "values"),
    [
        (SplineGuide, SPLINE | {"gain": math.inf}),
        (RacingLineGuide, RACING | {"max_steering": 100}),
        (SplineMemoryGuide, {"sight": 0, "sharpness": -1}),
    ],
)
def test_values_out_of_range_are_refused(guide, values):
    for name, value in values.items():
        with pytest.raises(ValueError, match=f"{name}={value!r}"):
            guide(**{name: value})
    with pytest.raises(ValueError, match=r"margin=2.0 .*less than car_length=2.0"):
        RacingLineGuide(margin=2.0)
