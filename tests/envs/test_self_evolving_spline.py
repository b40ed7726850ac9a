"""Properties of a spline that grows: it is the one fitted to all its points, and its state is all of it."""

import pytest
import torch
from point_batches import SLOTS, random_batch, tensors
from torch import Tensor

from coil_rl.envs.self_evolving_spline import SelfEvolvingSpline
from coil_rl.envs.splines import smoothing_spline


def test_wrong_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="capacity=1"):
        SelfEvolvingSpline(1, 3, 0.1)
    with pytest.raises(ValueError, match="mask"):
        SelfEvolvingSpline(4, 3, 0.1).add(torch.zeros(2, 1, 3), torch.ones(1, 2, dtype=torch.bool))


def test_growing_point_by_point_equals_fitting_all_at_once() -> None:
    points, count = random_batch()
    path = SelfEvolvingSpline(SLOTS, 37, 0.3, dtype=torch.float64)
    for k in range(SLOTS):
        path.add(points[:, k : k + 1], (k < count)[None])
    for a, b in zip(tensors(path.spline), tensors(smoothing_spline(points, count, 0.3)), strict=True):
        assert torch.equal(a, b)
    assert torch.equal(path.query(path.knots), path.spline.sample(path.knots))


def test_beyond_capacity_the_oldest_points_go() -> None:
    points, _ = random_batch()
    draw = torch.Generator().manual_seed(0)
    path = SelfEvolvingSpline(5, 37, 0.3, dtype=torch.float64)
    seen: list[list[Tensor]] = [[] for _ in range(37)]
    for first, many in ((0, 3), (3, 1), (4, 4), (8, 8)):
        mask = torch.rand(many, 37, generator=draw) < 0.6
        path.add(points[:, first : first + many], mask)
        for row in range(37):
            seen[row] += [points[:, first + k, row] for k in range(many) if mask[k, row]]
            kept = seen[row][-5:]
            assert path.count[row] == len(kept)
            assert not kept or torch.equal(path.points[:, : len(kept), row], torch.stack(kept, 1))


def test_reset_touches_only_masked_rows() -> None:
    points, count = random_batch()
    path = SelfEvolvingSpline(SLOTS, 37, 0.3, dtype=torch.float64)
    path.add(points, torch.arange(SLOTS)[:, None] < count)
    before = {name: state.clone() for name, state in path.state_dict().items()}
    gone = torch.arange(37) % 3 == 0
    path.reset(gone)
    for name, state in path.state_dict().items():
        assert state[..., gone].eq(0).all()
        assert torch.equal(state[..., ~gone], before[name][..., ~gone])
    path.add(points, (torch.arange(SLOTS)[:, None] < count) & gone)
    del before["points"]
    assert all(torch.equal(path.state_dict()[name], state) for name, state in before.items())


def test_state_dict_holds_everything_and_old_splines_stay() -> None:
    points, count = random_batch()
    path, copy = (SelfEvolvingSpline(SLOTS, (37,), 0.3, dtype=torch.float64) for _ in range(2))
    path.add(points[:, :4], torch.ones(4, 37, dtype=torch.bool))
    copy.load_state_dict(path.state_dict())
    old, frozen = path.spline, path.spline.equidistant(5)
    for each in (path, copy):
        each.add(points[:, 4:], torch.arange(4, SLOTS)[:, None] < count)
    assert torch.equal(path.spline.equidistant(5), copy.spline.equidistant(5))
    assert torch.equal(old.equidistant(5), frozen)
