"""The cone classifier, the cones in view, and the memory of the boundaries."""

from functools import partial

import numpy as np
import pytest
import torch
from drives import SENSORS, real_recording

from coil_rl.envs import (
    ConeClassifier,
    ConeTrackEnv,
    Perception,
    SimulatedLidar,
    shipped_tracks,
    simulated_cone_classifier,
    simulated_drive,
)
from coil_rl.envs.robot.course import THICK, THIN
from coil_rl.envs.robot.lidar import cast_beams
from coil_rl.envs.robot.perception import BoundaryMemory
from coil_rl.guides import SplineGuide

EXACT = SimulatedLidar(noise=0.0, noise_growth=0.0, no_return=0.0, outliers=0.0)


def test_clusters_are_classified_independently():
    features = np.random.default_rng(0).uniform(0, 0.12, (900, 3))
    classifier = simulated_cone_classifier()
    some = [0, 450, 899]
    together = classifier.decision(features)
    np.testing.assert_allclose(together[some], classifier.decision(features[some]))
    assert classifier.decision(features[:0]).shape == (0, 2)
    assert classifier.classify([[0.03, 0.01, 0.035], [0.085, 0.03, 0.1]]).tolist() == [0, 1]


@pytest.mark.parametrize("feature", range(3))
def test_clusters_larger_than_any_cone_are_no_cones(feature):
    features = np.random.default_rng(1).uniform(0, 0.1, (500, 3))
    features[:, feature] = np.linspace(0.3, 3, 500)
    assert (simulated_cone_classifier().classify(features) == -1).all()
    assert (simulated_cone_classifier().classify([[1e6, 1e6, 1e6], [0, 0, 1e9]]) == -1).all()


def classifier(**changed):
    machines = {"support": [[3.0, 4]], "weights": [[1.0], [0.5]]}
    machines |= {"intercept": [-0.5, -0.1], "gamma": 0.5}
    return ConeClassifier(**{"mean": [0.0, 0], "scale": [0.01, 0.01], **machines, **changed})


def perception(**options):
    return Perception(simulated_cone_classifier(), **options)


@pytest.mark.parametrize(
    ("make", "changed", "words"),
    [
        (classifier, {"weights": [[1.0], [2.0], [3.0]]}, "shapes"),
        (classifier, {"intercept": -0.5}, "shapes"),
        (classifier, {"support": [1.0, 2.0]}, "shapes"),
        (classifier, {"gamma": -1.0}, "more than 0"),
        (classifier, {"scale": [1.0, 0.0]}, "more than 0"),
        (classifier, {"intercept": [0.0, np.nan]}, "intercept of a cone classifier contains"),
        (perception, {"range_max": 0}, "range_max="),
        *((perception, {"range_min": value}, "range_min=") for value in (0, 2)),
        (perception, {"bearing_max": 181}, "bearing_max="),
        (perception, {"scale": -7}, "scale="),
        (perception, {"margin": -1}, "margin="),
        (partial(BoundaryMemory, 1), {"spline": "linear"}, "='linear' must be 'cubic' or 'quadra"),
    ],
)
def test_invalid_arguments_are_refused(make, changed, words):
    with pytest.raises(ValueError, match=words):
        make(**changed)


def scan_of(*cones: tuple[float, float, float]):
    """One noiseless scan of cones at (distance m, degrees, radius m) from a standing robot."""
    distance, degrees, radius = torch.tensor(cones).T
    centres = distance * torch.stack([degrees.deg2rad().cos(), degrees.deg2rad().sin()])
    true, _ = cast_beams(torch.zeros(3, 1, EXACT.beams), EXACT.angles, centres, radius)
    return EXACT.measure(true, torch.Generator())[0].numpy(), EXACT.angles.numpy()


def perceive(*cones, **options):
    """The left and the right cones in view."""
    found, count = Perception(simulated_cone_classifier(), **options)(*scan_of(*cones))
    return [found[0, side, : count[0, side]] for side in (0, 1)]


def test_thin_cones_are_left_thick_cones_right_nearest_first_and_scaled():
    thin = [(0.9, 20, THIN), (0.4, 30, THIN), (0.6, 0, THIN)]
    left, right = perceive(*thin, (0.5, -40, THICK), (0.8, -10, THICK))
    assert np.round(np.hypot(*left.T) / 7 + 0.015, 1).tolist() == [0.4, 0.6, 0.9]
    bearings = [np.degrees(np.arctan2(side[:, 1], side[:, 0])) for side in (left, right)]
    np.testing.assert_allclose(bearings[0], [30, 0, 20], atol=0.6)
    np.testing.assert_allclose(bearings[1], [-40, -10], atol=0.6)
    # The mean of the visible points is in front of the cone's centre.
    assert np.hypot(*right[0]) == pytest.approx(7 * (0.5 - THICK), abs=7 * THICK / 2)


def test_range_and_bearing_are_those_of_the_centroid():
    near, far = (0.99 + THICK - 0.005, 0, THICK), (1.015 + THICK, 0, THICK)
    beside = (0.5, 59, THICK), (0.5, -61, THICK)
    assert len(perceive(near)[1]) == 1
    assert len(perceive(far)[1]) == 0
    assert len(perceive(*beside)[1]) == 1
    assert len(perceive(*beside, bearing_max=120)[1]) == 2
    # With the preset of the authors.
    (cone,) = perceive(far, range_max=1.25, bearing_max=120, scale=5.625)[1]
    assert 5.625 * 1.015 < cone[0] < 5.625 * 1.06


def test_walls_are_no_cones():
    assert [len(side) for side in perceive((1.3, 0, 0.8))] == [0, 0]
    assert [len(side) for side in perceive((0.5, -30, THICK), (1.3, 30, 0.8))] == [0, 1]
    perception = Perception(simulated_cone_classifier())
    assert perception.rejected(*scan_of((0.5, -30, THICK), (1.3, 30, 0.8))) == 0.5
    assert perception.rejected(*scan_of((3.0, 0, THICK))) == 0


@pytest.mark.parametrize(("name", "topic"), SENSORS)
def test_share_of_clusters_in_rooms_without_cones_that_are_rejected(name, topic):
    recording = real_recording(name, topic)
    angles = recording.angles(slice(None))
    rejected = Perception(simulated_cone_classifier()).rejected(recording.ranges, angles)
    assert rejected == pytest.approx(SENSORS[name, topic][-1], abs=0.02)


def test_laser_yaw_rotates_the_view():
    (cone,) = perceive((0.5, 170, THICK), laser_yaw=-180)[1]
    assert np.degrees(np.arctan2(cone[1], cone[0])) == pytest.approx(-10, abs=0.6)
    assert [len(side) for side in perceive((0.5, 170, THICK))] == [0, 0]


def test_missing_cones_are_zero():
    two = perception(kept_cones=2)
    cones, count = two(*scan_of((0.4, 30, THIN), (0.6, 0, THIN), (0.9, -20, THIN)))
    assert count.tolist() == [[2, 0]]
    assert not cones[0, 1].any()
    assert np.hypot(*cones[0, 0].T).round(0).tolist() == [3, 4]
    cones, count = two(np.zeros((0, 360)), EXACT.angles.numpy())
    assert (cones.shape, count.shape) == ((0, 2, 2, 2), (0, 2))


@pytest.mark.parametrize("no_return", [np.nan, 0.0, -1.0, 65.0])
def test_all_codes_for_no_return_are_equal(no_return):
    ranges, angles = scan_of((0.4, 30, THIN), (0.6, -20, THICK))
    perception = Perception(simulated_cone_classifier())
    expected = perception(ranges, angles)
    found = perception(np.where(np.isfinite(ranges), ranges, no_return), angles)
    assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))


def test_scans_are_perceived_independently_in_any_order_of_the_beams():
    drive, perception = simulated_drive("both", seed=3), Perception(simulated_cone_classifier())
    ranges, angles = drive.ranges.repeat(3, 1).numpy(), drive.angles.numpy()
    cones, count = perception(ranges, angles)
    assert len(cones) > 512
    for row in (0, 300, len(cones) - 1):
        alone = perception(ranges[row : row + 1, ::-1], angles[::-1] + 2 * np.pi)
        np.testing.assert_allclose(alone[0][0], cones[row], atol=1e-5)
        assert alone[1][0].tolist() == count[row].tolist()


def view(left=(), right=(), batch=1):
    """Cones of one car, equal in every row, and their number."""
    cones = torch.zeros(batch, 2, 16, 2)
    for side, positions in enumerate((left, right)):
        for slot, position in enumerate(positions):
            cones[:, side, slot] = torch.tensor(position)
    return cones, torch.tensor([[len(left), len(right)]]).expand(batch, 2)


LEFT, RIGHT = [(1.5, 1.0), (3.0, 1.2), (5.0, 1.0)], [(1.5, -1.0), (3.0, -1.2)]


def test_observation_of_valid_sides_is_that_of_the_cone_world():
    env = ConeTrackEnv(shipped_tracks("test"), 3, assignment="cyclic")
    memory = BoundaryMemory(3)
    rollout = env.rollout(60, SplineGuide(), break_when_any_done=False)
    both = 0
    for step in range(60):
        state = rollout[:, step]
        observation, valid = memory(state["cones"], state["cone_count"])
        assert torch.equal(valid, state["cone_count"] >= 2)
        sides = valid.repeat_interleave(10, 1)
        torch.testing.assert_close(observation[sides], state["observation"][sides])
        both += int(valid.all(1).sum())
    assert both > 50


@pytest.mark.parametrize(
    "invalid",
    [LEFT[:1], [], [(1.5, 1.0), (9.5, 1.0)], [(0.2, 0.1), (0.4, -0.2)]],
    ids=["one cone", "none", "too far", "inside the robot"],
)
def test_invalid_side_keeps_its_last_valid_numbers(invalid):
    memory = BoundaryMemory(1)
    last, valid = memory(*view(LEFT, RIGHT))
    assert valid.all()
    for step in range(3):
        moved = [(x - 0.1 * step, y) for x, y in RIGHT]
        held, valid = memory(*view(invalid, moved))
        assert valid.tolist() == [[False, True]]
        assert torch.equal(held[:, :10], last[:, :10])
        assert torch.equal(held[:, 10:], BoundaryMemory(1)(*view([], moved))[0][:, 10:])
    fresh, valid = memory(*view(LEFT[1:], RIGHT))
    assert valid.all()
    assert torch.equal(fresh, BoundaryMemory(1)(*view(LEFT[1:], RIGHT))[0])
    assert not torch.equal(fresh[:, :10], last[:, :10])


def test_rows_are_reset_independently_and_the_state_can_be_loaded():
    never, _ = BoundaryMemory(1)(*view(LEFT[:1], RIGHT))
    assert not never[:, :10].any()
    assert never[:, 10:].any()
    memory, other = BoundaryMemory(2), BoundaryMemory(2)
    full, _ = memory(*view(LEFT, RIGHT, batch=2))
    other.load_state_dict(memory.state_dict())
    memory.reset(torch.tensor([True, False]))
    observation, valid = memory(*view(batch=2))
    assert not valid.any()
    assert not observation[0].any()
    assert torch.equal(observation[1], full[1])
    assert torch.equal(other(*view(batch=2))[0], full)
