"""The simulated LiDAR."""

import numpy as np
import pytest
import torch

from coil_rl.envs import SimulatedLidar
from coil_rl.envs.robot.lidar import RANGE_MAX, RANGE_MIN, cast_beams, move_along_arc

STANDING = torch.zeros(3, 1, 360)


def cast(*cones, poses=STANDING):
    x, y, radius = torch.tensor(cones).T
    return cast_beams(poses, SimulatedLidar().angles, torch.stack([x, y]), radius)


def test_beam_ends_at_the_near_side_of_the_first_cone():
    true, hit = cast((1.0, 0.0, 0.045), (2.0, 0.0, 0.2), (0.0, 1.5, 0.02))
    lidar = SimulatedLidar()
    front, left = (int((lidar.angles - at).abs().argmin()) for at in (0.0, np.pi / 2))
    assert true[0, front].item() == pytest.approx(0.955, abs=1e-6)
    assert true[0, left].item() == pytest.approx(1.48, abs=1e-6)
    assert (hit[0, front], hit[0, left]) == (0, 2)
    # The far cone is wider than the shadow of the near one (5.2 degrees).
    shadow, whole = (2 * np.degrees(np.arcsin(size)) for size in (0.045, 0.1))
    assert abs(int((hit == 0).sum()) - shadow) <= 1
    assert abs(int((hit == 1).sum()) - (whole - shadow)) <= 2
    assert (hit == -1).equal(true.isinf())


def test_turning_during_a_scan_shifts_the_bearings():
    lidar = SimulatedLidar()
    turn = 0.05
    poses = torch.zeros(3, 1, 360)
    poses[2] = turn * lidar.phase
    middle = []
    for given in (STANDING, poses):
        seen = cast((1.0, 0.0, 0.2), (-1.0, 0.3, 0.2), poses=given)[0][0].isfinite()
        parts = lidar.angles.abs() < 1, lidar.angles > 2
        middle.append([float(lidar.angles[seen & part].mean()) for part in parts])
    assert lidar.phase[-1] == 0
    # What is behind on the left is measured first, before the robot has turned.
    expected = [turn / 2, turn * 0.05]
    np.testing.assert_allclose(np.subtract(*middle), expected, atol=0.01)


def test_noise_is_that_of_the_sensor():
    lidar = SimulatedLidar()
    for distance in (0.3, 1.0, 2.0):
        true = torch.full((500, 360), distance)
        ranges, outlier = lidar.measure(true, torch.Generator().manual_seed(1))
        good = ranges.isfinite() & ~outlier
        sigma = 0.0007 + 0.001 * distance**2
        assert (ranges[good] - distance).std().item() == pytest.approx(sigma, rel=0.03)
        assert (ranges[good] - distance).mean().item() == pytest.approx(0, abs=3e-5)
        assert ranges.isinf().float().mean().item() == pytest.approx(0.02, abs=0.002)
        assert outlier.float().mean().item() == pytest.approx(0.005, abs=0.001)
        steps = ranges[good] / 0.00025
        torch.testing.assert_close(steps, steps.round(), rtol=0, atol=2e-3)


def test_ranges_outside_the_limits_have_no_return():
    ranges, outlier = SimulatedLidar().measure(
        torch.tensor([0.1, 0.14, torch.inf, 13.0]).repeat(500, 1), torch.Generator()
    )
    assert ranges[~outlier].isinf().all()
    outliers = ranges[outlier]
    assert ((outliers >= RANGE_MIN) & (outliers <= RANGE_MAX)).all()
    assert len(outliers) > 3


def test_random_draws_do_not_depend_on_the_distances():
    first, second = torch.Generator().manual_seed(4), torch.Generator().manual_seed(4)
    SimulatedLidar().measure(torch.full((3, 360), torch.inf), first)
    SimulatedLidar().measure(torch.full((3, 360), 0.5), second)
    assert torch.equal(first.get_state(), second.get_state())


def test_arc_equals_many_small_steps():
    pose = torch.tensor([0.3, -0.2, 0.7], dtype=torch.float64)
    steps = pose
    for _ in range(2000):
        half = torch.stack([steps[0], steps[1], steps[2] + 0.4 / 4000])
        x = half[0] + 0.5 / 2000 * half[2].cos()
        y = half[1] + 0.5 / 2000 * half[2].sin()
        steps = torch.stack([x, y, steps[2] + 0.4 / 2000])
    found = move_along_arc(pose, *torch.tensor([0.5, 0.4]).double())
    torch.testing.assert_close(found, steps, atol=1e-7, rtol=0)


@pytest.mark.parametrize(
    "wrong", [{"beams": 0}, {"rate": -1}, {"noise": -0.1}, {"no_return": 0.7, "outliers": 0.4}]
)
def test_invalid_options_are_refused(wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))}="):
        SimulatedLidar(**wrong)


def all_pairs(poses, angles, cones, radius):
    """Return what `cast_beams` does, computed for all pairs of beams and cones."""
    direction = poses[2] + angles
    cos, sin = direction.cos().unsqueeze(-1), direction.sin().unsqueeze(-1)
    x, y = (c.unsqueeze(-2) - s.unsqueeze(-1) for c, s in zip(cones, poses[:2], strict=True))
    along, across = x * cos + y * sin, y * cos - x * sin
    half_chord_squared = radius.square().unsqueeze(-2) - across.square()
    distance = along - half_chord_squared.clamp(min=0).sqrt()
    nearest, cone = torch.where((half_chord_squared > 0) & (along > 0), distance, torch.inf).min(-1)
    return nearest, torch.where(nearest.isfinite(), cone, -1)


@pytest.mark.parametrize("own", ["one turn for all", "bearings, cones and gaps of each sensor"])
def test_beams_in_windows_are_those_of_all_pairs_to_the_last_bit(own):
    lidar, draw = SimulatedLidar(), torch.Generator().manual_seed(0)
    cones, radius = 3 * torch.rand(2, 40, 40, generator=draw), 0.1 * torch.rand(40, generator=draw)
    heading = 20 * torch.randn(1, 40, generator=draw)
    start = torch.cat([3 * torch.rand(2, 40, generator=draw), heading])
    start[:2, :3] = cones[:, 0, :3] + 0.01  # within a cone
    turn = torch.randn(40, 1, generator=draw)
    poses = move_along_arc(start.unsqueeze(-1), 0.1 * lidar.phase, turn * lidar.phase)
    angles = lidar.angles
    if own.startswith("one"):
        cones = cones[:, 0]
    else:
        angles = angles + torch.randn(40, 1, generator=draw)
        angles[::2] = angles[::2].flip(-1)
        radius = radius.expand(40, 40)
        poses[:, 5:9, 300:] = torch.nan
    expected = all_pairs(poses, angles, cones, radius)
    for found, value in zip(cast_beams(poses, angles, cones, radius), expected, strict=True):
        known = ~poses[0].isnan()
        assert torch.equal(found[known], value[known])
        assert bool((found[~known].isinf() | (found[~known] == -1)).all())


def test_no_sensor_and_no_cone_are_allowed():
    lidar = SimulatedLidar()
    poses = torch.zeros(3, 2, 360)
    nearest, cone = cast_beams(poses, lidar.angles, torch.zeros(2, 0), torch.zeros(0))
    assert bool(nearest.isinf().all())
    assert bool((cone == -1).all())
    cones = torch.ones(2, 4)
    assert cast_beams(poses[:, :0], lidar.angles, cones, torch.ones(4))[0].shape == (0, 360)


def test_rows_of_one_case_have_the_same_noise():
    true = torch.rand(2, 360, generator=torch.Generator().manual_seed(0)) + 0.5
    few, _ = SimulatedLidar().measure(true, torch.Generator().manual_seed(1))
    again = torch.Generator().manual_seed(1)
    many, _ = SimulatedLidar().measure(true.repeat(3, 1), again, different=2)
    assert torch.equal(many, few.repeat(3, 1))
