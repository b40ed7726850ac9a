import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracle import guide_action
from tensordict import TensorDict
from torch import Tensor

from coil_rl.guides.spline import SplineGuide

SLOTS = 16
seeds = st.integers(0, 2**31)
every_spline = pytest.mark.parametrize("spline", ["cubic", "quadratic"])
Point = tuple[float, float]


def sight(left: list[Point], right: list[Point], steering: float = 0.0) -> tuple[Tensor, Tensor, Tensor]:
    """What one car sees, nearest first: the arguments of a guide."""
    cones = torch.zeros(1, 2, SLOTS, 2, dtype=torch.float64)
    for side, points in enumerate((left, right)):
        for slot, point in enumerate(sorted(points, key=lambda p: math.hypot(*p))):
            cones[0, side, slot] = torch.tensor(point, dtype=torch.float64)
    return cones, torch.tensor([[len(left), len(right)]]), torch.full((1, 1), steering, dtype=torch.float64)


def advice(left: list[Point], right: list[Point], steering: float = 0.0, **kwargs) -> float:
    return SplineGuide(**kwargs).steer(*sight(left, right, steering)).item()


def roads(seed: int, cars: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, Tensor]:
    """Bends of any curvature, seen from anywhere on them, up to five cones a side and sometimes none."""
    draw = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(cars, *shape, dtype=torch.float64, generator=draw)

    along = torch.arange(SLOTS) * uniform(1, 2, 2, 1) + uniform(0.3, 1.5, 2, 1)
    side = torch.tensor([1.2, -1.2], dtype=torch.float64).view(1, 2, 1) + uniform(-0.4, 0.4, 2, SLOTS)
    y = side + uniform(-0.3, 0.3, 1, 1) * along**2 + uniform(-0.5, 0.5, 1, 1)
    cones = torch.stack([along, y], dim=-1)
    order = cones.square().sum(-1).argsort(dim=-1).unsqueeze(-1).expand_as(cones)
    count = torch.randint(0, 6, (cars, 2), generator=draw)
    return cones.gather(2, order).to(dtype), count, uniform(-1, 1, 1).to(dtype)


def equation_103(x: float, y: float, sharpness: float = 1.8) -> float:
    alpha, distance = math.degrees(math.atan2(y, x)), math.hypot(x, y)
    return 160 / math.pi * math.atan(alpha / distance**sharpness) / 80


# Two midpoints, (2, 0.5) and (3, 0.5), and so a straight path whose ends are the two targets.
TWO_MIDPOINTS = ([(2.0, 2.0)], [(2.0, -1.0), (4.0, -1.0)])


def test_a_plan_has_midpoints_nearest_first_and_targets_a_metre_apart() -> None:
    cones, count, _ = sight(*TWO_MIDPOINTS)
    plan = SplineGuide().plan(cones, count)
    places = torch.tensor([[2, 3], [0.5, 0.5]], dtype=torch.float64)
    assert plan.pairs.tolist() == [2]
    assert torch.allclose(plan.midpoints[..., 0], places)
    assert torch.allclose(plan.targets[:, :2, 0], places)
    assert torch.allclose(plan.targets[:, 2:, 0], places[:, 1:])
    assert plan.square[:, 0].tolist() == pytest.approx([4.25, 9.25, 9.25])
    assert plan.barred[:, 0].tolist() == [0, 0, 0]


@every_spline
def test_advice_is_equation_103_of_the_nearest_target(spline: str) -> None:
    assert equation_103(2, 0.5) == pytest.approx(0.83687, abs=1e-5)
    assert advice(*TWO_MIDPOINTS, spline=spline) == pytest.approx(equation_103(2, 0.5), abs=1e-12)


def test_sharpness_one_is_the_printed_formula() -> None:
    assert advice(*TWO_MIDPOINTS, sharpness=1) == pytest.approx(equation_103(2, 0.5, sharpness=1), abs=1e-12)


def test_gain_scales_the_advice_but_not_the_steering_kept() -> None:
    assert advice(*TWO_MIDPOINTS, gain=0.5) == pytest.approx(equation_103(2, 0.5) / 2, abs=1e-12)
    assert advice([], [], steering=0.3, gain=0.5) == 0.3


def test_action_is_a_fraction_of_the_largest_steering() -> None:
    assert advice(*TWO_MIDPOINTS, max_steering=40) == pytest.approx(advice(*TWO_MIDPOINTS), abs=1e-12)


@every_spline
def test_a_target_already_reached_is_passed_over(spline: str) -> None:
    # Midpoints (0.5, 0) and (1.5, 0.5); the nearer one is within 0.625 m.
    here = ([(0.5, 1.0)], [(0.5, -1.0), (2.5, 0.0)])
    assert advice(*here, spline=spline) == pytest.approx(equation_103(1.5, 0.5), abs=1e-12)


@every_spline
def test_a_target_to_the_side_is_passed_over(spline: str) -> None:
    # Midpoints (0.25, 0.9), at 74 degrees, and (1.25, 0.9).
    here = ([(0.5, 1.9)], [(0.0, -0.1), (2.0, -0.1)])
    assert advice(*here, spline=spline) == pytest.approx(equation_103(1.25, 0.9), abs=1e-12)


@every_spline
def test_pairs_of_four_metres_or_more_are_no_pairs(spline: str) -> None:
    assert advice([(2.0, 3.0)], [(2.0, -1.0), (3.0, -1.0)], 0.25, spline=spline) == 0.25
    assert advice([(2.0, 2.9)], [(2.0, -1.0), (2.5, -1.0)], 0.25, spline=spline) != 0.25


@every_spline
@pytest.mark.parametrize(
    ("left", "right"),
    [
        ([], []),
        ([(2.0, 1.0), (4.0, 1.0)], []),
        ([], [(2.0, -1.0), (4.0, -1.0)]),
        ([(2.0, 1.0)], [(2.0, -1.0)]),
        ([(0.2, 1.0)], [(0.2, -1.0), (0.4, -1.0)]),
        ([(0.5, 3.0)], [(0.5, 2.0), (0.5, 1.0)]),
    ],
    ids=["no cones", "left only", "right only", "one pair", "all reached", "all to the side"],
)
def test_without_a_target_the_steering_is_kept(left: list[Point], right: list[Point], spline: str) -> None:
    for steering in (0.0, -0.7, 1.0):
        assert advice(left, right, steering, spline=spline) == steering


@every_spline
def test_a_straight_road_needs_no_steering(spline: str) -> None:
    road = [(0.8 + 1.6 * i, 1.2) for i in range(4)]
    assert advice(road, [(x, -y) for x, y in road], 0.5, spline=spline) == pytest.approx(0, abs=1e-6)


@every_spline
def test_a_bend_to_the_left_is_steered_to_the_left(spline: str) -> None:
    left, right = ([(0.5 + 1.5 * i, side + 0.15 * i**2) for i in range(4)] for side in (1.2, -1.2))
    assert advice(left, right, spline=spline) > 0.05


@every_spline
@given(seed=seeds)
def test_a_mirrored_road_is_steered_the_other_way(spline: str, seed: int) -> None:
    guide = SplineGuide(spline).steer
    cones, count, steering = roads(seed, cars=40)
    mirrored = cones.flip(1) * torch.tensor([1.0, -1.0])
    assert torch.allclose(guide(mirrored, count.flip(1), -steering), -guide(cones, count, steering), rtol=0, atol=1e-9)


@every_spline
def test_advice_is_the_oracles_on_any_road(spline: str) -> None:
    cones, count, steering = roads(8, cars=300)
    ours = SplineGuide(spline).steer(cones, count, steering)
    for car in range(300):
        left, right = (cones[car, side, : count[car, side]].numpy() for side in range(2))
        theirs = guide_action(left, right, steering[car].item(), spline=spline)
        assert ours[car].item() == pytest.approx(theirs, abs=1e-6)


@every_spline
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_advice_does_not_depend_on_the_other_cars(spline: str, dtype: torch.dtype) -> None:
    guide = SplineGuide(spline).steer
    inputs = roads(9, cars=1003, dtype=dtype)
    together = guide(*inputs)
    for car in range(0, 1003, 17):
        assert torch.equal(guide(*(value[car : car + 1] for value in inputs)), together[car : car + 1])


@every_spline
@given(seed=seeds)
def test_what_lies_in_the_padding_has_no_influence(spline: str, seed: int) -> None:
    guide = SplineGuide(spline).steer
    cones, count, steering = roads(seed, cars=20)
    padding = torch.arange(SLOTS) >= count.unsqueeze(-1)
    shuffled = torch.where(padding.unsqueeze(-1), cones.flip(2) - 3, cones)
    assert torch.equal(guide(shuffled, count, steering), guide(cones, count, steering))
    fewer = cones[:, :, :6]
    assert torch.equal(guide(fewer, count, steering), guide(cones, count, steering))


coordinates = st.sampled_from([0.0, 1.0, 1.0 + 1e-7, -1.0, 2.0, 5.0]) | st.floats(-7, 7, width=32)
points = st.lists(st.tuples(coordinates, coordinates), max_size=SLOTS)


@every_spline
@given(left=points, right=points, again=st.booleans(), steering=st.floats(-1, 1, width=32))
def test_advice_is_an_action_whatever_is_seen(
    spline: str, left: list[Point], right: list[Point], again: bool, steering: float
) -> None:
    if again:
        left, right = (left + left)[:SLOTS], (right + left)[:SLOTS]
    inputs = sight(left, right, steering)
    for dtype in (torch.float32, torch.float64):
        action = SplineGuide(spline).steer(inputs[0].to(dtype), inputs[1], inputs[2].to(dtype))
        assert action.shape == (1, 1)
        assert action.dtype == dtype
        assert action.abs() <= 1


@every_spline
def test_cones_all_in_one_place_do_no_harm(spline: str) -> None:
    for place in ((0.0, 0.0), (3.0, 0.5), (-2.0, 1.0)):
        action = advice([place] * SLOTS, [place] * SLOTS, 0.1, spline=spline)
        assert abs(action) <= 1


def test_guide_reads_what_the_env_writes() -> None:
    guide = SplineGuide()
    assert guide.in_keys == ["cones", "cone_count", "steering"]
    assert guide.out_keys == ["action"]
    assert not list(guide.parameters())
    assert not guide.state_dict()


def test_guide_can_write_beside_the_action() -> None:
    cones, count, steering = roads(2, cars=5)
    data = TensorDict({"seen": cones, "cone_count": count, "steering": steering}, 5)
    guide = SplineGuide(in_keys=("seen", "cone_count", "steering"), out_key=("guide", "action"))
    written = guide(data)
    assert "action" not in written
    assert torch.equal(written["guide", "action"], SplineGuide().steer(cones, count, steering))


def test_an_unknown_spline_is_named() -> None:
    with pytest.raises(ValueError, match="spline='linear' must be one of cubic, quadratic"):
        SplineGuide("linear")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "value"),
    [("cones", 0), ("midpoints", 1), ("targets", 1), ("smoothing", -1), ("sharpness", math.nan), ("max_steering", 0),
     ("gain", math.inf)],
)  # fmt: skip
def test_a_value_outside_its_range_is_named(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name}={value}"):
        SplineGuide(**{name: value})  # type: ignore[arg-type]
