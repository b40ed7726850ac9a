from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from coil_rl.envs import random_tracks, shipped_tracks
from coil_rl.envs.track_map import TrackMap

POSES = 500


@cache
def tracks():
    return [*shipped_tracks("all")[::2], *random_tracks(2, seed=21)]


@cache
def track_map(dtype):
    return TrackMap(tracks(), dtype=dtype)


def random_poses(track, seed, spread):
    """Random poses around the cones of a track, within the area of the map: [POSES, 3]."""
    rng = np.random.default_rng(seed)
    cones = np.vstack([track.left, track.right])
    offset = rng.normal(scale=spread, size=(POSES, 2)).clip(-1.99, 1.99)
    position = cones[rng.integers(len(cones), size=POSES)] + offset
    return np.column_stack([position, rng.uniform(-10, 10, POSES)])


def visible(pose, ring):
    """Return which cones of a ring are visible: [poses, cones] bool."""
    offset = ring - pose[:, None, :2]
    angle = np.arctan2(offset[..., 1], offset[..., 0]) - pose[:, 2:]
    angle = np.abs((angle + np.pi) % (2 * np.pi) - np.pi)
    mask = (np.linalg.norm(offset, axis=-1) <= 7) & (angle <= np.pi / 3)
    return mask


def candidates(lookup, track, pose):
    return lookup.candidates(lookup.locate(track, pose[:2]), pose[2])


def clearances(lookup, track, position):
    location = lookup.locate(track, position)
    return lookup.clearance(location, lookup.to_boundaries(location))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_candidates_include_all_visible_cones(dtype):
    lookup = track_map(dtype)
    for index, track in enumerate(tracks()):
        # Rounded to the precision of the env.
        pose = torch.tensor(random_poses(track, index, spread=2), dtype=dtype)
        slot, _ = candidates(lookup, torch.full((POSES,), index), pose.t())
        for side, ring in enumerate((track.left, track.right)):
            listed = np.zeros((POSES, 2 * lookup.slots), dtype=bool)
            listed[np.arange(POSES), slot[:, side].numpy()] = True
            ours = listed[:, side * lookup.slots : side * lookup.slots + len(ring)]
            assert not (visible(pose.double().numpy(), ring) & ~ours).any()


@pytest.mark.slow
def test_candidates_are_the_cones_of_their_slots():
    lookup = track_map(torch.float64)
    for index, track in enumerate(tracks()):
        pose = torch.tensor(random_poses(track, index, spread=2))
        slot, position = candidates(lookup, torch.full((POSES,), index), pose.t())
        for side, ring in enumerate((track.left, track.right)):
            place = slot[:, side] - side * lookup.slots
            real = place < len(ring)
            # A duplicate slot would reward a cone twice.
            assert (torch.diff(place, dim=0) > 0)[real[1:]].all()
            padded = torch.tensor(np.vstack([ring, np.full((lookup.slots - len(ring), 2), 1e4)]))
            assert torch.equal(position[:, :, side], padded[place].movedim(-1, 0))


def test_clearance_is_the_distance_to_the_nearest_crash():
    lookup = track_map(torch.float64)
    for index, track in enumerate(tracks()):
        position = random_poses(track, index, spread=1)[:, :2]
        to_cone = cKDTree(np.vstack([track.left, track.right])).query(position)[0]
        boundary = np.vstack([track.boundary("left", 0.001), track.boundary("right", 0.001)])
        truth = np.minimum(to_cone - 0.4, cKDTree(boundary).query(position)[0] - 0.25)
        which, where = torch.full((POSES,), index), torch.tensor(position.T)
        ours = clearances(lookup, which, where).numpy()
        # A car moves 8 cm a step, so it is never more than 10 cm past the crash distance.
        relevant = (truth > -0.1) & (truth < 1)
        assert relevant.sum() > POSES / 2
        np.testing.assert_allclose(
            ours[relevant], truth[relevant], rtol=0, atol=3e-3, err_msg=track.name
        )
        assert ((ours <= 0) == (truth <= 0))[np.abs(truth) > 3e-3].all()
        assert (ours[truth >= 1] > 0.9).all()
        single = clearances(track_map(torch.float32), which, where.float()).numpy()
        np.testing.assert_allclose(single[ours < 1], ours[ours < 1], rtol=0, atol=1e-4)


def test_positions_far_from_the_track_have_no_cones_and_finite_clearance():
    lookup = track_map(torch.float32)
    which = torch.arange(len(lookup.tracks))
    for x, y in ((-1e3, 0.0), (1e3, 1e3), (0.0, -1e6)):
        pose = torch.tensor([[x], [y], [1.0]]).expand(3, len(lookup.tracks))
        _, position = candidates(lookup, which, pose)
        clearance = clearances(lookup, which, pose[:2])
        assert ((position - pose[:2].view(2, 1, 1, -1)).square().sum(0) > 49).all()
        assert clearance.isfinite().all()
        assert (clearance > 0).all()


def test_tables_of_a_track_do_not_depend_on_other_tracks():
    lookup = track_map(torch.float64)
    for index in (0, len(tracks()) - 1):
        alone = TrackMap([tracks()[index]], dtype=torch.float64)
        pose = torch.tensor(random_poses(tracks()[index], index, spread=1)).t()
        zero = torch.zeros(POSES, dtype=torch.int64)
        assert torch.equal(
            clearances(alone, zero, pose[:2]), clearances(lookup, zero + index, pose[:2])
        )
        _, few = candidates(alone, zero, pose)
        _, many = candidates(lookup, zero + index, pose)
        assert torch.equal(many[:, : few.shape[1]], few)
        assert many[:, few.shape[1] :].eq(1e4).all()
