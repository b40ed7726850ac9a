import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from coil_rl.envs.sight import Frame, encode_samples, view

seeds = st.integers(0, 2**31)
both_dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def sides(
    left,
    right,
    dtype=torch.float64,
):
    """Cones of one car, padded with cones behind it: [2, candidates, 2, 1]."""
    most = max(len(left), len(right))
    filled = [side + [(-1.0, 0.0)] * (most - len(side)) for side in (left, right)]
    return torch.tensor(filled, dtype=dtype).permute(2, 1, 0).unsqueeze(-1)


def polar(distance, degrees):
    return distance * math.cos(math.radians(degrees)), distance * math.sin(math.radians(degrees))


def visible(left, dtype=torch.float64):
    result = view(sides(left, [], dtype), limit=16)
    mask = torch.zeros(len(left), *result.count.shape, dtype=result.real.dtype)
    return (mask.scatter_add(0, result.candidate.long(), result.real) > 0)[:, 0, 0].tolist()


def random_cones(seed, candidates=20, cars=7):
    draw = torch.Generator().manual_seed(seed)
    return 6 * torch.randn(2, candidates, 2, cars, dtype=torch.float64, generator=draw)


def brute_force(local, side, car, limit):
    points = local[:, :, side, car].numpy()
    distance, angle = np.hypot(*points), np.degrees(np.arctan2(points[1], points[0]))
    rows = np.flatnonzero((distance <= 7) & (np.abs(angle) <= 60))
    return [int(i) for i in rows[np.argsort(distance[rows])][:limit]]


@given(seeds, st.integers(1, 20))
def test_view_agrees_with_brute_force(seed, limit):
    local = random_cones(seed)
    result = view(local, limit)
    for car in range(local.shape[-1]):
        for side in range(2):
            expected = brute_force(local, side, car, limit)
            count = int(result.count[side, car])
            assert count == len(expected)
            assert torch.equal(result.cones[:, :count, side, car], local[:, expected, side, car])
            assert result.cones[:, count:, side, car].eq(0).all()
            assert result.candidate[:count, side, car].tolist() == expected


@both_dtypes
def test_cones_are_visible_up_to_seven_metres_and_sixty_degrees(dtype):
    ahead = [(7.0, 0.0), (7.00001, 0.0), (6.99999, 0.0), (0.0, 0.0)]
    assert visible(ahead, dtype) == [True, False, True, True]
    # 60 degrees has no exact floating-point representation.
    degrees = [59.999, 60.001, -59.999, -60.001, 90.0, 120.0, 180.0]
    seen = [True, False, True, False, False, False, False]
    assert visible([polar(5, angle) for angle in degrees], dtype) == seen


def test_points_left_of_the_car_are_positive():
    pose = torch.tensor([[1.0], [2.0], [math.pi / 2]], dtype=torch.float64)
    points = torch.tensor([[[1.0], [0.0]], [[5.0], [2.0]]], dtype=torch.float64)
    assert Frame(pose).to_car(points).squeeze(-1).flatten().tolist() == pytest.approx([3, 0, 0, 1])


def test_samples_are_encoded_as_distance_and_angle():
    samples = torch.zeros(2, 5, 2, 1, dtype=torch.float64)
    left = [(7.0, 0.0), (0.0, 3.5), (0.0, 0.0), (-1.0, 0.0), polar(14, 30)]
    right = [polar(1.75, -60), polar(5.25, -120), polar(7, -150), (3.5, 0.0), (0.0, -7.0)]
    samples[:, :, 0, 0], samples[:, :, 1, 0] = torch.tensor(left).t(), torch.tensor(right).t()
    # Distance and angle of each sample, left ones first.
    expected = [1, 0, 0, 0.75, -1, 0, 2 / 7 - 1, 1, 1, 0.25]
    expected += [-0.5, -0.5, 0.5, -1, 1, -1, 0, 0, 1, -0.75]
    known = torch.ones(2, 1)
    assert encode_samples(samples, known).tolist()[0] == pytest.approx(expected, abs=1e-6)


@both_dtypes
def test_observations_agree_with_hypot_and_atan2(dtype):
    line = torch.tensor([-7.0, -1.0, -1e-6, -0.0, 0.0, 1e-6, 0.5, 3.0], dtype=dtype)
    x, y = torch.meshgrid(line, line, indexing="ij")
    samples = torch.stack([x, y]).view(2, 1, 1, -1).expand(2, 5, 2, -1)
    observation = encode_samples(samples, torch.ones(2, 64, dtype=dtype))
    distance, angle = observation.view(64, 10, 2)[:, 7].unbind(-1)
    known = torch.atan2(y, x).flatten() * (x != 0).logical_or(y != 0).flatten()
    assert torch.allclose(distance, (torch.hypot(x, y).flatten() * 2 / 7 - 1).clamp(-1, 1))
    # A sample straight behind the car is encoded as left of it.
    expected = known.where(y.flatten() != 0, known.abs()) / math.radians(120)
    assert torch.allclose(angle, expected.clamp(-1, 1))
