import torch

from coil_rl.envs.constants import constant, flat_index


def test_constants_are_cached_by_type_and_number_of_dimensions() -> None:
    flat, deep = torch.zeros(3), torch.zeros(4, 2, 5)
    assert constant(0.1, flat) is constant(0.1, flat)
    assert constant(range(4), deep).shape == (4, 1, 1)
    assert constant(range(4), flat).shape == (4,)
    assert constant((1, -1), flat.double()).dtype == torch.float64
    assert constant(0.1, flat.double()).item() == 0.1
    assert constant(range(4), deep, torch.int32).dtype == torch.int32


def test_constants_created_in_inference_mode_support_autograd() -> None:
    with torch.inference_mode():
        constant(0.123, torch.zeros(2))
    leaf = torch.ones(2, requires_grad=True)
    (leaf * constant(0.123, leaf)).square().sum().backward()
    assert torch.allclose(leaf.grad, torch.full((2,), 2 * 0.123**2))


def test_flat_index_selects_what_gather_selects() -> None:
    draw = torch.Generator().manual_seed(0)
    values = torch.randn(6, 2, 5, generator=draw)
    rows = torch.randint(6, (3, 2, 5), generator=draw)
    selected = values.flatten().index_select(0, flat_index(rows)).view(3, 2, 5)
    assert torch.equal(selected, values.gather(0, rows))
