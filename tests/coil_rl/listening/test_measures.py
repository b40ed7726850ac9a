import pytest
import torch
from tensordict import TensorDict
from torch import nn

from coil_rl.listening import agreement, gradient, intervention


def states(count=500, guides=2, size=1):
    torch.manual_seed(0)
    return TensorDict(
        {"observation": torch.randn(count, 3), "guide_action": torch.rand(count, guides, size) * 2 - 1}, [count]
    )


def first(seen):
    return seen["guide_action"][:, 0]


def test_an_agent_that_does_what_the_first_guide_says_listens_to_that_one_only():
    seen = states()
    gap = (seen["guide_action"][:, 0] - seen["guide_action"][:, 1]).abs().squeeze(-1)
    assert (agreement(first, seen)[:, 0] == 0).all()
    assert (agreement(first, seen)[:, 1] == gap).all()
    moved = intervention(first, seen, donors=64, generator=torch.Generator().manual_seed(0))
    assert (moved[:, 1] == 0).all()
    # Two independent draws from [-1, 1] are 2/3 apart in the mean.
    assert moved[:, 0].mean() == pytest.approx(2 / 3, abs=0.04)
    assert gradient(first, seen).unique(dim=0).tolist() == [[1.0, 0.0]]


def test_an_agent_that_agrees_by_coincidence_is_not_said_to_listen():
    seen = states()
    seen["guide_action"][:, 0] = seen["observation"][:, :1]
    learned = nn.Linear(3, 1)
    with torch.no_grad():
        learned.weight.copy_(torch.tensor([[1.0, 0.0, 0.0]]))
        learned.bias.zero_()
    assert (agreement(lambda s: learned(s["observation"]), seen)[:, 0] == 0).all()
    assert (intervention(lambda s: learned(s["observation"]), seen) == 0).all()
    assert (gradient(lambda s: learned(s["observation"]), seen) == 0).all()


def test_gradient_is_that_of_finite_differences():
    seen = states(50, guides=3, size=2).double()
    network = nn.Sequential(nn.Linear(9, 16), nn.Tanh(), nn.Linear(16, 2)).double()

    def act(s):
        return network(torch.cat([s["observation"], s["guide_action"].flatten(1)], -1))

    found, step = gradient(act, seen), 1e-6
    for guide in range(3):
        squares = torch.zeros(50, dtype=torch.float64)
        for axis in range(2):
            there, back = seen.clone(), seen.clone()
            there["guide_action"][:, guide, axis] += step
            back["guide_action"][:, guide, axis] -= step
            squares += ((act(there) - act(back)).detach() / (2 * step)).square().sum(-1)
        torch.testing.assert_close(found[:, guide], squares.sqrt(), rtol=1e-6, atol=1e-8)


def test_a_choice_has_no_gradient():
    assert gradient(lambda s: (s["guide_action"][:, 0] > 0).float(), states()).isnan().all()


def test_an_advice_that_never_changes_moves_nothing():
    seen = states()
    seen["guide_action"][:, 1] = 0.3
    moved = intervention(lambda s: s["guide_action"].sum(1), seen)
    assert (moved[:, 1] == 0).all()
    assert (moved[:, 0] > 0).all()


def test_interventions_are_seeded_and_leave_the_states_as_they_are():
    seen, before = states(), states()
    runs = [intervention(first, seen, 4, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    assert (runs[0] == runs[1]).all()
    assert (runs[0] != runs[2]).any()
    gradient(lambda s: s.set("more", s["guide_action"])["guide_action"][:, 0], seen)
    assert set(seen.keys()) == set(before.keys())
    assert (seen == before).all()


def test_donors_are_at_least_one():
    with pytest.raises(ValueError, match="donors=0 must be at least 1"):
        intervention(first, states(), donors=0)
