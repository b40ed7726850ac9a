"""The boundary estimate: straight rows of cones, kept estimates, and held ones."""

import pytest
import torch

from coil_rl.envs.boundaries import Boundaries
from coil_rl.envs.sight import Frame, view
from coil_rl.envs.splines import spline_fit

SIGHT = 7.0
POSE = torch.tensor([[3.0], [1.0], [0.5]], dtype=torch.float64)


def straight(left, right):
    """Return cones every metre, 1 m to each side of a car, [2, N, 2, 1] m in its frame."""
    ahead = torch.arange(1.0, max(left, right) + 1, dtype=torch.float64)
    cones = torch.stack([ahead, torch.ones_like(ahead)])
    sides = [cones.clone(), cones * torch.tensor([[1.0], [-1.0]], dtype=torch.float64)]
    for side, count in zip(sides, (left, right), strict=True):
        side[:, count:] = -50.0  # behind the car, out of sight
    return torch.stack(sides, -1).unsqueeze(-1)


def observed(cones, *, hold, new=True, samples=None):
    """Return what one car observes of cones in its frame, with the new state."""
    if samples is None:
        samples = torch.zeros(2, 5, 2, 1, dtype=torch.float64)
    frame = Frame(POSE)
    boundaries = Boundaries(spline_fit("cubic", 0.1), SIGHT, hold=hold)
    return boundaries.observe(
        frame,
        view(cones, 16, SIGHT),
        frame.to_world(cones),
        torch.tensor([new]),
        samples,
        torch.zeros(2, 1, dtype=torch.float64),
    )


@pytest.mark.parametrize("hold", [False, True])
def test_samples_of_straight_rows_lie_on_them(hold):
    _, samples, sampled = observed(straight(5, 5), hold=hold)
    local = Frame(POSE).to_car(samples)
    assert sampled.tolist() == [[1.0], [1.0]]
    torch.testing.assert_close(local[1, :, 0, 0], torch.ones(5, dtype=torch.float64))
    torch.testing.assert_close(local[1, :, 1, 0], -torch.ones(5, dtype=torch.float64))
    torch.testing.assert_close(local[0, :, 0, 0], torch.linspace(1, 5, 5, dtype=torch.float64))


def test_side_with_one_cone_keeps_its_estimate():
    _, before, _ = observed(straight(5, 5), hold=False)
    _, after, sampled = observed(straight(5, 1), hold=False, samples=before + 0.25)
    assert sampled.tolist() == [[1.0], [0.0]]
    torch.testing.assert_close(after[..., 0, :], before[..., 0, :])
    torch.testing.assert_close(after[..., 1, :], before[..., 1, :] + 0.25)


def test_held_boundary_stays_until_a_cone_comes_into_sight():
    _, before, _ = observed(straight(5, 5), hold=True)
    _, kept, _ = observed(straight(3, 3), hold=True, new=False, samples=before)
    _, fresh, _ = observed(straight(3, 3), hold=True, samples=before)
    assert kept.equal(before)
    assert not fresh.equal(before)
