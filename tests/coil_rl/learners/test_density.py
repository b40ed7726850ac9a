"""Distributions of actions have the numbers of PyTorch's and TorchRL's, random ones too."""

import pytest
import torch
from torch.distributions import Categorical, Independent, kl_divergence
from torchrl.modules import IndependentNormal, OneHotCategorical, TanhNormal
from torchrl.modules.distributions.utils import rsample_and_log_prob

from coil_rl.learners.density import Choices, Normal, OneHotChoice, SquashedNormal, padding

ROWS = 200
torch.manual_seed(0)
LOC, SCALE = torch.randn(ROWS, 2), torch.rand(ROWS, 2) + 0.05
LOW, HIGH = torch.tensor([-2.0, 0.0]), torch.tensor([2.0, 5.0])
LOGITS = torch.randn(ROWS, 3, 4)
BOUNDS = {"low": LOW, "high": HIGH}


def several(logits):
    return Independent(Categorical(logits=logits), 1)


PAIRS = {
    "normal": (lambda loc: Normal(loc, SCALE, 1), lambda loc: IndependentNormal(loc, SCALE), LOC),
    "squashed": (
        lambda loc: SquashedNormal(loc, SCALE, 1),
        lambda loc: TanhNormal(loc, SCALE, low=-torch.ones(2), high=torch.ones(2), event_dims=1),
        LOC,
    ),
    "squashed to bounds": (
        lambda loc: SquashedNormal(loc, SCALE, 1, (LOW, HIGH)),
        lambda loc: TanhNormal(loc, SCALE, **BOUNDS, event_dims=1),
        LOC,
    ),
    "choice": (Choices, lambda logits: Categorical(logits=logits), LOGITS[:, 0]),
    "one-hot": (OneHotChoice, lambda logits: OneHotCategorical(logits=logits), LOGITS[:, 0]),
    "choices": (lambda logits: Choices(logits, 1), several, LOGITS),
}


@pytest.mark.parametrize("kind", PAIRS)
def test_sample_and_log_prob_are_those_of_the_libraries(kind):
    make, make_reference, parameters = PAIRS[kind]
    density, reference = make(parameters), make_reference(parameters)
    torch.manual_seed(1)
    sample, log_prob = density.draw()
    torch.manual_seed(1)
    pair = rsample_and_log_prob(reference) if "squashed" in kind else None
    drawn = reference.sample() if pair is None else pair[0]
    torch.testing.assert_close(sample, drawn, rtol=1e-6, atol=1e-6)
    of_draw = reference.log_prob(drawn) if pair is None else pair[1]
    torch.testing.assert_close(log_prob, of_draw, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(
        density.log_prob(drawn), reference.log_prob(drawn), rtol=1e-5, atol=1e-5
    )
    if kind != "squashed to bounds":
        assert torch.equal(sample, drawn)


@pytest.mark.parametrize("kind", PAIRS)
def test_mode_entropy_and_divergence_are_those_of_the_libraries(kind):
    make, make_reference, parameters = PAIRS[kind]
    density, reference = make(parameters), make_reference(parameters)
    name = "deterministic_sample" if hasattr(reference, "deterministic_sample") else "mode"
    torch.testing.assert_close(density.mode, getattr(reference, name), rtol=1e-6, atol=1e-6)
    if "squashed" not in kind:
        torch.testing.assert_close(density.entropy(), reference.entropy())
    if kind in ("normal", "choice", "choices"):
        other = parameters.flip(0)
        expected = kl_divergence(reference, make_reference(other))
        torch.testing.assert_close(density.divergence(make(other)), expected)


def test_entropy_of_squashed_numbers_is_an_estimate():
    density = SquashedNormal(torch.zeros(20_000, 1), torch.full((20_000, 1), 0.01), 1)
    normal = Normal(density.loc, density.scale, 1)  # almost the same where tanh is straight
    assert float(density.entropy().mean()) == pytest.approx(float(normal.entropy()[0]), abs=0.05)


@pytest.mark.parametrize("kind", ["normal", "squashed", "squashed to bounds"])
def test_given_noise_is_what_is_drawn_from(kind):
    make, _, parameters = PAIRS[kind]
    density = make(parameters)
    torch.testing.assert_close(density.draw(torch.zeros_like(LOC))[0], density.mode)


def test_padding_is_no_option():
    logits = LOGITS.clone()
    logits[:, 1, 2:] = padding(logits.dtype)
    density = Choices(logits, 1)
    assert density.valid.tolist() == [[True] * 4, [True, True, False, False], [True] * 4]
    assert density.logits.softmax(-1)[:, 1, 2:].max() == 0
    assert density.entropy().isfinite().all()
