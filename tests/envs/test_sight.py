import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from coil_rl.envs.sight import Frame, View, boundary_samples, encode, view
from coil_rl.envs.splines import quadratic_spline, smoothing_spline

seeds = st.integers(0, 2**31)
both_dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def sides(
    left: list[tuple[float, float]], right: list[tuple[float, float]], dtype: torch.dtype = torch.float64
) -> Tensor:
    """Cones of one car, filled up with cones behind it: [2, candidates, 2, 1]."""
    most = max(len(left), len(right))
    filled = [side + [(-1.0, 0.0)] * (most - len(side)) for side in (left, right)]
    return torch.tensor(filled, dtype=dtype).permute(2, 1, 0).unsqueeze(-1)


def at(distance: float, degrees: float) -> tuple[float, float]:
    return distance * math.cos(math.radians(degrees)), distance * math.sin(math.radians(degrees))


def seen(left: list[tuple[float, float]], dtype: torch.dtype = torch.float64) -> list[bool]:
    return in_sight(view(sides(left, [], dtype), kept=16), len(left))[:, 0, 0].tolist()


def in_sight(result: View, candidates: int) -> Tensor:
    """Which candidates are in view: [candidates, 2, B] bool."""
    seen = torch.zeros(candidates, *result.count.shape, dtype=result.real.dtype)
    return seen.scatter_add(0, result.place.long(), result.real) > 0


def crowd(seed: int, candidates: int = 20, cars: int = 7) -> Tensor:
    draw = torch.Generator().manual_seed(seed)
    return 6 * torch.randn(2, candidates, 2, cars, dtype=torch.float64, generator=draw)


def brute_force(local: Tensor, side: int, car: int, kept: int) -> list[int]:
    points = local[:, :, side, car].numpy()
    distance, angle = np.hypot(*points), np.degrees(np.arctan2(points[1], points[0]))
    visible = np.flatnonzero((distance <= 7) & (np.abs(angle) <= 60))
    return [int(i) for i in visible[np.argsort(distance[visible])][:kept]]


@given(seeds, st.integers(1, 20))
def test_cones_in_view_are_the_visible_ones_nearest_first(seed: int, kept: int) -> None:
    local = crowd(seed)
    result: View = view(local, kept)
    for car in range(local.shape[-1]):
        for side in range(2):
            expected = brute_force(local, side, car, kept)
            count = int(result.count[side, car])
            assert count == len(expected)
            assert torch.equal(result.cones[:, :count, side, car], local[:, expected, side, car])
            assert result.cones[:, count:, side, car].eq(0).all()
            assert result.place[:count, side, car].tolist() == expected


@both_dtypes
def test_sight_ends_at_seven_metres(dtype: torch.dtype) -> None:
    assert seen([(7.0, 0.0), (7.00001, 0.0), (6.99999, 0.0)], dtype) == [True, False, True]


@both_dtypes
def test_sight_ends_at_sixty_degrees(dtype: torch.dtype) -> None:
    # Exactly 60 degrees is not a floating-point number.
    angles = [59.999, 60.001, -59.999, -60.001, 90.0, 120.0, 180.0]
    assert seen([at(5, angle) for angle in angles], dtype) == [True, False, True, False, False, False, False]


def test_a_cone_under_the_car_is_in_sight() -> None:
    assert seen([(0.0, 0.0)]) == [True]


def test_equally_near_cones_keep_their_order() -> None:
    cones = [(3.0, 1.0), (3.0, -1.0), (1.0, 0.0), (3.0, 1.0)]
    result = view(sides(cones, cones[::-1]), kept=3)
    assert result.cones[:, :, 0, 0].t().tolist() == [[1, 0], [3, 1], [3, -1]]
    assert result.cones[:, :, 1, 0].t().tolist() == [[1, 0], [3, 1], [3, -1]]
    assert in_sight(result, 4)[:, 0, 0].tolist() == [True, True, True, False]


def test_beyond_the_limit_the_nearest_cones_are_kept() -> None:
    cones = [(7.0 - 0.25 * i, 0.0) for i in range(20)]
    result = view(sides(cones, cones[:1]), kept=16)
    assert result.count[:, 0].tolist() == [16, 1]
    assert result.cones[0, :, 0, 0].tolist() == [2.25 + 0.25 * i for i in range(16)]
    assert in_sight(result, 20)[:, 0, 0].tolist() == [False] * 4 + [True] * 16


def test_nothing_in_sight_is_all_zeros() -> None:
    result = view(sides([(-3.0, 0.0)], [(8.0, 0.0)]), kept=16)
    assert result.count.eq(0).all()
    assert result.cones.eq(0).all()
    assert not result.real.any()


def test_a_view_does_not_depend_on_the_other_cars() -> None:
    local = crowd(5, cars=37).float()
    together = view(local, 16)
    for car in (0, 17, 36):
        alone = view(local[..., car : car + 1], 16)
        assert torch.equal(alone.count, together.count[..., car : car + 1])
        # How many slots there are is decided by the car that sees most.
        most = alone.cones.shape[1]
        assert torch.equal(alone.cones, together.cones[:, :most, :, car : car + 1])
        assert together.cones[:, most:, :, car].eq(0).all()


def test_left_of_the_car_is_positive() -> None:
    pose = torch.tensor([[1.0], [2.0], [math.pi / 2]], dtype=torch.float64)
    points = torch.tensor([[[1.0], [0.0]], [[5.0], [2.0]]], dtype=torch.float64)
    assert Frame(pose).to_car(points).squeeze(-1).flatten().tolist() == pytest.approx([3, 0, 0, 1])


@given(seeds)
def test_to_world_undoes_to_car(seed: int) -> None:
    draw = torch.Generator().manual_seed(seed)
    pose = 20 * torch.randn(3, 7, dtype=torch.float64, generator=draw)
    points = 20 * torch.randn(2, 5, 2, 7, dtype=torch.float64, generator=draw)
    frame = Frame(pose)
    assert torch.allclose(frame.to_world(frame.to_car(points)), points, rtol=0, atol=1e-12)
    assert torch.allclose(frame.to_car(frame.to_world(points)), points, rtol=0, atol=1e-12)


def test_samples_become_distance_and_angle_from_left_to_right() -> None:
    samples = torch.zeros(2, 5, 2, 1, dtype=torch.float64)
    left = [(7.0, 0.0), (0.0, 3.5), (0.0, 0.0), (-1.0, 0.0), at(14, 30)]
    right = [at(1.75, -60), at(5.25, -120), at(7, -150), (3.5, 0.0), (0.0, -7.0)]
    samples[:, :, 0, 0], samples[:, :, 1, 0] = torch.tensor(left).t(), torch.tensor(right).t()
    expected = [1, 0, 0, 0.75, -1, 0, 2 / 7 - 1, 1, 1, 0.25, -0.5, -0.5, 0.5, -1, 1, -1, 0, 0, 1, -0.75]
    known = torch.ones(2, 1)
    assert encode(samples, known).tolist()[0] == pytest.approx(expected, abs=1e-6)


def test_an_unknown_side_reads_as_zeros() -> None:
    samples = torch.full((2, 5, 2, 3), 2.0)
    known = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    observation = encode(samples, known)
    assert observation[0, :10].ne(0).all()
    assert observation[0, 10:].eq(0).all()
    assert observation[1, :10].eq(0).all()
    assert observation[1, 10:].ne(0).all()
    assert observation[2].eq(0).all()


@given(seeds)
def test_observations_stay_within_bounds(seed: int) -> None:
    draw = torch.Generator().manual_seed(seed)
    samples = 10 ** (4 * torch.rand(2, 5, 2, 64, generator=draw) - 2) * torch.randn(2, 5, 2, 64, generator=draw)
    assert encode(samples, torch.ones(2, 64, dtype=torch.bool)).abs().max() <= 1


@pytest.mark.parametrize("fit", [quadratic_spline, lambda points, count: smoothing_spline(points, count, 0.1)])
def test_boundary_samples_of_a_straight_row_lie_evenly_on_it(fit) -> None:
    row = [(2.0 + i, 1.0) for i in range(5)]
    result = view(sides(row, row[:2]), kept=16)
    samples = boundary_samples(result.cones, result.count, fit).squeeze(-1)
    assert samples[0, :, 0].tolist() == pytest.approx([2, 3, 4, 5, 6])
    assert samples[0, :, 1].tolist() == pytest.approx([2, 2.25, 2.5, 2.75, 3])
    assert samples[1].flatten().tolist() == pytest.approx([1] * 10)


@both_dtypes
def test_observations_are_hypot_and_atan2_up_to_seven_metres_and_120_degrees(dtype: torch.dtype) -> None:
    line = torch.tensor([-7.0, -1.0, -1e-6, -0.0, 0.0, 1e-6, 0.5, 3.0], dtype=dtype)
    x, y = torch.meshgrid(line, line, indexing="ij")
    samples = torch.stack([x, y]).view(2, 1, 1, -1).expand(2, 5, 2, -1)
    distance, angle = encode(samples, torch.ones(2, 64, dtype=dtype)).view(64, 10, 2)[:, 7].unbind(-1)
    known = torch.atan2(y, x).flatten() * (x != 0).logical_or(y != 0).flatten()
    assert torch.allclose(distance, (torch.hypot(x, y).flatten() * 2 / 7 - 1).clamp(-1, 1))
    # Straight behind the car is left of it.
    assert torch.allclose(angle, (known.where(y.flatten() != 0, known.abs()) / math.radians(120)).clamp(-1, 1))


@both_dtypes
def test_observations_do_not_depend_on_the_other_cars(dtype: torch.dtype) -> None:
    draw = torch.Generator().manual_seed(1)
    samples = 3 * torch.randn(2, 5, 2, 1003, dtype=dtype, generator=draw)
    known = torch.ones(2, 1003)
    together = encode(samples, known)
    for car in range(0, 1003, 17):
        assert torch.equal(encode(samples[..., car : car + 1], known[:, :1]), together[car : car + 1])
