from functools import cache

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from coil_rl.envs import Track, random_tracks, shipped_tracks
from coil_rl.envs.track_map import TrackMap

Array = NDArray[np.float64]
POSES = 2000


@cache
def tracks() -> list[Track]:
    return [*shipped_tracks("all")[::2], *random_tracks(2, seed=21)]


@cache
def track_map(dtype: torch.dtype) -> TrackMap:
    return TrackMap(tracks(), dtype=dtype)


def random_poses(track: Track, seed: int, spread: float) -> Array:
    """Poses about the cones of a track, no farther off than the map reaches, in any direction: [POSES, 3]."""
    rng = np.random.default_rng(seed)
    cones = np.vstack([track.left, track.right])
    off = rng.normal(scale=spread, size=(POSES, 2)).clip(-1.99, 1.99)
    position = cones[rng.integers(len(cones), size=POSES)] + off
    return np.column_stack([position, rng.uniform(-10, 10, POSES)])


def visible(pose: Array, ring: Array) -> Array:
    """Which cones of a ring are in sight: [poses, cones] bool."""
    offset = ring - pose[:, None, :2]
    angle = np.arctan2(offset[..., 1], offset[..., 0]) - pose[:, 2:]
    angle = np.abs((angle + np.pi) % (2 * np.pi) - np.pi)
    seen: Array = (np.linalg.norm(offset, axis=-1) <= 7) & (angle <= np.pi / 3)
    return seen


def candidates(world: TrackMap, track: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    return world.candidates(world.locate(track, pose[:2]), pose[2])


def clearances(world: TrackMap, track: Tensor, position: Tensor) -> Tensor:
    place = world.locate(track, position)
    return world.clearance(place, world.to_boundaries(place))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_candidates_hold_every_visible_cone(dtype: torch.dtype) -> None:
    world = track_map(dtype)
    for index, track in enumerate(tracks()):
        # As the env has them: rounded to its precision.
        pose = torch.tensor(random_poses(track, index, spread=2), dtype=dtype)
        slot, _ = candidates(world, torch.full((POSES,), index), pose.t())
        for side, ring in enumerate((track.left, track.right)):
            listed = np.zeros((POSES, 2 * world.slots), dtype=bool)
            listed[np.arange(POSES), slot[:, side].numpy()] = True
            ours = listed[:, side * world.slots : side * world.slots + len(ring)]
            assert not (visible(pose.double().numpy(), ring) & ~ours).any()


def test_candidates_are_the_cones_of_their_slots() -> None:
    world = track_map(torch.float64)
    for index, track in enumerate(tracks()):
        pose = torch.tensor(random_poses(track, index, spread=2))
        slot, position = candidates(world, torch.full((POSES,), index), pose.t())
        for side, ring in enumerate((track.left, track.right)):
            place = slot[:, side] - side * world.slots
            real = place < len(ring)
            # A slot twice would pay a cone twice.
            assert (torch.diff(place, dim=0) > 0)[real[1:]].all()
            padded = torch.tensor(np.vstack([ring, np.full((world.slots - len(ring), 2), 1e4)]))
            assert torch.equal(position[:, :, side], padded[place].movedim(-1, 0))


def test_clearance_is_the_distance_to_the_nearest_crash() -> None:
    world = track_map(torch.float64)
    for index, track in enumerate(tracks()):
        position = random_poses(track, index, spread=1)[:, :2]
        to_cone = cKDTree(np.vstack([track.left, track.right])).query(position)[0]
        boundary = np.vstack([track.boundary("left", 0.001), track.boundary("right", 0.001)])
        truth = np.minimum(to_cone - 0.4, cKDTree(boundary).query(position)[0] - 0.25)
        ours = clearances(world, torch.full((POSES,), index), torch.tensor(position.T)).numpy()
        # Farther in than 10 cm a car never gets: it moves 8 cm a step and has crashed the step before.
        asked = (truth > -0.1) & (truth < 1)
        assert asked.sum() > POSES / 2
        np.testing.assert_allclose(ours[asked], truth[asked], rtol=0, atol=3e-3, err_msg=track.name)
        assert ((ours <= 0) == (truth <= 0))[np.abs(truth) > 3e-3].all()
        assert (ours[truth >= 1] > 0.9).all()


def test_float32_knows_the_clearance_as_well() -> None:
    for index, track in enumerate(tracks()):
        position = torch.tensor(random_poses(track, index, spread=1)[:, :2].T)
        which = torch.full((POSES,), index)
        truth = clearances(track_map(torch.float64), which, position)
        near = truth < 1
        ours = clearances(track_map(torch.float32), which, position.float()).double()
        assert torch.allclose(ours[near], truth[near], rtol=0, atol=1e-4)


def test_far_from_every_track_there_is_nothing() -> None:
    world = track_map(torch.float32)
    which = torch.arange(len(world))
    for x, y in ((-1e3, 0.0), (1e3, 1e3), (0.0, -1e6)):
        pose = torch.tensor([[x], [y], [1.0]]).expand(3, len(world))
        _, position = candidates(world, which, pose)
        clearance = clearances(world, which, pose[:2])
        assert ((position - pose[:2].view(2, 1, 1, -1)).square().sum(0) > 49).all()
        assert clearance.isfinite().all()
        assert (clearance > 0).all()


def test_a_track_is_the_same_alone_and_among_others() -> None:
    world = track_map(torch.float64)
    for index in (0, len(tracks()) - 1):
        alone = TrackMap([tracks()[index]], dtype=torch.float64)
        pose = torch.tensor(random_poses(tracks()[index], index, spread=1)).t()
        zero = torch.zeros(POSES, dtype=torch.int64)
        assert torch.equal(clearances(alone, zero, pose[:2]), clearances(world, zero + index, pose[:2]))
        _, few = candidates(alone, zero, pose)
        _, many = candidates(world, zero + index, pose)
        assert torch.equal(many[:, : few.shape[1]], few)
        assert many[:, few.shape[1] :].eq(1e4).all()


def test_no_tracks_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one track"):
        TrackMap([])
