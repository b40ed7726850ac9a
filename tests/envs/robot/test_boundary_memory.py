import pytest
import torch

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.envs.robot.boundary_memory import BoundaryMemory
from coil_rl.guides import SplineGuide


def seen(left=(), right=(), batch=1):
    """Cones of one car, the same in every row, and how many they are."""
    cones = torch.zeros(batch, 2, 16, 2)
    for side, places in enumerate((left, right)):
        for slot, place in enumerate(places):
            cones[:, side, slot] = torch.tensor(place)
    return cones, torch.tensor([[len(left), len(right)]]).expand(batch, 2)


LEFT, RIGHT = [(1.5, 1.0), (3.0, 1.2), (5.0, 1.0)], [(1.5, -1.0), (3.0, -1.2)]


def test_while_both_sides_show_two_cones_it_is_the_observation_of_the_cone_world():
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


@pytest.mark.parametrize("run", [1, 2, 7])
@pytest.mark.parametrize(
    "wrong",
    [LEFT[:1], [], [(1.5, 1.0), (9.5, 1.0)], [(0.2, 0.1), (0.4, -0.2)]],
    ids=["one cone", "none", "too far", "inside the robot"],
)
def test_through_a_run_of_scans_that_are_not_valid_a_side_stays_as_it_was(wrong, run):
    memory = BoundaryMemory(1)
    last, valid = memory(*seen(LEFT, RIGHT))
    assert valid.all()
    for step in range(run):
        moved = [(x - 0.1 * step, y) for x, y in RIGHT]
        held, valid = memory(*seen(wrong, moved))
        assert valid.tolist() == [[False, True]]
        assert torch.equal(held[:, :10], last[:, :10])
        assert torch.equal(held[:, 10:], BoundaryMemory(1)(*seen([], moved))[0][:, 10:])
    fresh, valid = memory(*seen(LEFT[1:], RIGHT))
    assert valid.all()
    assert torch.equal(fresh, BoundaryMemory(1)(*seen(LEFT[1:], RIGHT))[0])
    assert not torch.equal(fresh[:, :10], last[:, :10])


def test_before_anything_valid_a_side_reads_as_zeros():
    observation, _ = BoundaryMemory(1)(*seen(LEFT[:1], RIGHT))
    assert not observation[:, :10].any()
    assert observation[:, 10:].any()


def test_rows_forget_by_themselves_and_the_state_can_be_kept():
    memory, other = BoundaryMemory(2), BoundaryMemory(2)
    full, _ = memory(*seen(LEFT, RIGHT, batch=2))
    other.load_state_dict(memory.state_dict())
    memory.reset(torch.tensor([True, False]))
    observation, valid = memory(*seen(batch=2))
    assert not valid.any()
    assert not observation[0].any()
    assert torch.equal(observation[1], full[1])
    assert torch.equal(other(*seen(batch=2))[0], full)


def test_settings_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="spline='linear' must be one of cubic, quadratic"):
        BoundaryMemory(1, spline="linear")
    with pytest.raises(ValueError, match="nearest=9"):
        BoundaryMemory(1, nearest=9)
