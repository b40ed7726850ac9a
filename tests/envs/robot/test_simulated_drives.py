import numpy as np
import pytest
import torch

from coil_rl.envs import SimulatedLidar, labelling_drives, robot_track, simulated_drive
from coil_rl.envs.robot.course import middle_line


@pytest.fixture(scope="module")
def both():
    return simulated_drive("both", seed=5)


def test_a_lap_is_scanned_five_and_a_half_times_a_second_on_the_way_round(both):
    assert both.seconds[1].item() == pytest.approx(1 / 5.5)
    assert both.ranges.shape == both.hit.shape == (len(both.seconds), 360)
    assert both.seconds[-1].item() == pytest.approx(6 / 0.15, abs=1)
    line = torch.from_numpy(middle_line(robot_track(), 0.01)).float()
    off = torch.cdist(both.poses[:2].flatten(1).t(), line).amin(1)
    assert 0.03 < off.max() < 0.05
    speed = (both.poses[:2, 1:, 0] - both.poses[:2, :-1, 0]).norm(dim=0) * 5.5
    assert speed.median().item() == pytest.approx(0.15, rel=0.05)


def test_the_robot_looks_where_it_drives_and_moves_while_it_scans(both):
    way = both.poses[:2, 1:, 0] - both.poses[:2, :-1, 0]
    off = torch.remainder(torch.atan2(way[1], way[0]) - both.poses[2, :-1, 0] + torch.pi, 2 * torch.pi) - torch.pi
    assert off.abs().max() < 0.05
    ends = both.poses[:, :-1, -1] - both.poses[:, 1:, 0]
    assert ends[:2].norm(dim=0).max() < 0.001
    assert (both.poses[:2, :, -1] - both.poses[:2, :, 0]).norm(dim=0).min() > 0.02


def test_ranges_tell_of_the_cone_they_are_said_to_tell_of(both):
    angle = both.poses[2] + both.angles
    place = both.poses[:2] + torch.where(both.hit >= 0, both.ranges, 0) * torch.stack([angle.cos(), angle.sin()])
    told = (both.hit >= 0) & both.ranges.isfinite()
    off = (place[:, told] - both.cones[:, both.hit[told]]).norm(dim=0) - both.radius[both.hit[told]]
    assert told.sum() > 10_000
    # Noise along a beam that grazes a cone leaves its surface by less than this.
    assert off.abs().max() < 0.045


def test_visibility_is_the_share_of_a_cone_that_nothing_hides(both):
    assert both.visibility.min() == 0
    assert both.visibility.max() == 1
    partly = (both.visibility > 0.01) & (both.visibility < 0.99)
    assert 0.03 < partly.float().mean() < 0.3
    nearest = (both.cones[:, None] - both.poses[:2, :, 0, None]).norm(dim=0).argmin(1, keepdim=True)
    assert (both.visibility.gather(1, nearest) == 1).float().mean() > 0.95


def test_a_labelling_drive_meets_cones_of_one_kind_only():
    drives = labelling_drives([0, 1])
    assert [drive.name for drive in drives] == ["left_0", "right_0", "left_1", "right_1"]
    assert [set(drive.thick.tolist()) for drive in drives] == [{False}, {True}] * 2
    assert not torch.equal(drives[0].ranges, drives[2].ranges)


def test_a_drive_is_fixed_by_its_seed(both):
    assert torch.equal(simulated_drive("both", seed=5).ranges, both.ranges)
    assert not torch.equal(simulated_drive("both", seed=6).ranges, both.ranges)


def test_without_noise_the_seed_only_decides_how_it_sways():
    exact = SimulatedLidar(noise=0, noise_growth=0, no_return=0, outliers=0)
    first, second = (simulated_drive("left", seed, lidar=exact, sway=0.0) for seed in (0, 1))
    assert torch.equal(first.ranges, second.ranges)
    assert np.isfinite(first.ranges.numpy()).any(1).all()


def test_sides_that_do_not_exist_are_refused():
    with pytest.raises(ValueError, match="sides='middle' must be one of left, right, both"):
        simulated_drive("middle", 0)
