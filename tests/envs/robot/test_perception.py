import numpy as np
import pytest
import torch

from coil_rl.envs import Perception, SimulatedLidar, simulated_cone_classifier, simulated_drive
from coil_rl.envs.robot.course import THICK, THIN

EXACT = SimulatedLidar(noise=0.0, noise_growth=0.0, no_return=0.0, outliers=0.0)


def scan_of(*cones: tuple[float, float, float]):
    """One noiseless scan of cones at (distance m, degrees, radius m), seen from a robot that stands still."""
    distance, degrees, radius = torch.tensor(cones).T
    place = distance * torch.stack([degrees.deg2rad().cos(), degrees.deg2rad().sin()])
    true, _ = EXACT.cast(torch.zeros(3, 1, EXACT.beams), place, radius)
    return EXACT.measure(true, torch.Generator())[0].numpy(), EXACT.angles.numpy()


def perceive(*cones, **rules):
    found, count = Perception(simulated_cone_classifier(), **rules)(*scan_of(*cones))
    return [found[0, side, : count[0, side]] for side in (0, 1)]


def test_thin_cones_are_left_and_thick_ones_right_nearest_first_and_seven_times_as_far():
    left, right = perceive((0.9, 20, THIN), (0.4, 30, THIN), (0.5, -40, THICK), (0.8, -10, THICK), (0.6, 0, THIN))
    assert np.round(np.hypot(*left.T) / 7 + 0.015, 1).tolist() == [0.4, 0.6, 0.9]
    np.testing.assert_allclose(np.degrees(np.arctan2(left[:, 1], left[:, 0])), [30, 0, 20], atol=0.6)
    np.testing.assert_allclose(np.degrees(np.arctan2(right[:, 1], right[:, 0])), [-40, -10], atol=0.6)
    # The mean of the points that are seen lies before the middle of a cone.
    assert np.hypot(*right[0]) == pytest.approx(7 * (0.5 - THICK), abs=7 * THICK / 2)


def test_range_and_bearing_are_those_of_the_centroid():
    near, far = (0.99 + THICK - 0.005, 0, THICK), (1.015 + THICK, 0, THICK)
    assert [len(side) for side in perceive(near)] == [0, 1]
    assert [len(side) for side in perceive(far)] == [0, 0]
    assert [len(side) for side in perceive((0.5, 59, THICK), (0.5, -61, THICK))] == [0, 1]
    assert [len(side) for side in perceive((0.5, 59, THICK), (0.5, -61, THICK), bearing_max=120)] == [0, 2]
    # With the authors' rules.
    (cone,) = perceive(far, range_max=1.25, bearing_max=120, scale=5.625)[1]
    assert 5.625 * 1.015 < cone[0] < 5.625 * 1.06


def test_the_yaw_of_the_lidar_turns_what_is_seen():
    (cone,) = perceive((0.5, 170, THICK), laser_yaw=-180)[1]
    assert np.degrees(np.arctan2(cone[1], cone[0])) == pytest.approx(-10, abs=0.6)
    assert [len(side) for side in perceive((0.5, 170, THICK))] == [0, 0]


def test_what_is_no_cone_in_sight_is_zero():
    perception = Perception(simulated_cone_classifier(), kept_cones=2)
    cones, count = perception(*scan_of((0.4, 30, THIN), (0.6, 0, THIN), (0.9, -20, THIN)))
    assert count.tolist() == [[2, 0]]
    assert not cones[0, 1].any()
    assert np.hypot(*cones[0, 0].T).round(0).tolist() == [3, 4]
    cones, count = perception(np.zeros((0, 360)), EXACT.angles.numpy())
    assert (cones.shape, count.shape) == ((0, 2, 2, 2), (0, 2))


@pytest.mark.parametrize("nothing", [np.inf, np.nan, 0.0, 0.003, -1.0, 65.0])
def test_no_return_is_nothing_however_a_driver_spells_it(nothing):
    ranges, angles = scan_of((0.4, 30, THIN), (0.6, -20, THICK))
    expected = Perception(simulated_cone_classifier())(ranges, angles)
    found = Perception(simulated_cone_classifier())(np.where(np.isfinite(ranges), ranges, nothing), angles)
    assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))


def test_a_scan_is_perceived_by_itself_in_any_order_of_the_beams():
    drive, perception = simulated_drive("both", seed=3, laps=3), Perception(simulated_cone_classifier())
    ranges, angles = drive.ranges.numpy(), drive.angles.numpy()
    cones, count = perception(ranges, angles)
    assert len(cones) > 512
    for row in (0, 300, 600):
        alone = perception(ranges[row : row + 1, ::-1], angles[::-1] + 2 * np.pi)
        np.testing.assert_allclose(alone[0][0], cones[row], atol=1e-5)
        assert alone[1][0].tolist() == count[row].tolist()


@pytest.mark.parametrize(
    "wrong",
    [
        {"range_max": 0},
        {"range_min": 0},
        {"range_min": 2},
        {"bearing_max": 181},
        {"scale": -7},
        {"margin": -1},
        {"gap": 0},
    ],
)
def test_rules_that_cannot_be_are_refused(wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))}="):
        Perception(simulated_cone_classifier(), **wrong)
