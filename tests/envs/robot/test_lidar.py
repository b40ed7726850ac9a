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
    standing, turning = (
        cast((1.0, 0.0, 0.2), (-1.0, 0.3, 0.2), poses=p)[0][0].isfinite() for p in (STANDING, poses)
    )
    assert lidar.phase[-1] == 0
    middle = [
        [
            float(lidar.angles[seen & part].mean())
            for part in (lidar.angles.abs() < 1, lidar.angles > 2)
        ]
        for seen in (standing, turning)
    ]
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
        steps = torch.stack(
            [
                half[0] + 0.5 / 2000 * half[2].cos(),
                half[1] + 0.5 / 2000 * half[2].sin(),
                steps[2] + 0.4 / 2000,
            ]
        )
    found = move_along_arc(pose, *torch.tensor([0.5, 0.4]).double())
    torch.testing.assert_close(found, steps, atol=1e-7, rtol=0)


@pytest.mark.parametrize(
    "wrong", [{"beams": 0}, {"rate": -1}, {"noise": -0.1}, {"no_return": 0.7, "outliers": 0.4}]
)
def test_invalid_options_are_refused(wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))}="):
        SimulatedLidar(**wrong)
