import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from coil_rl.envs.sorting import smallest

both_dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def sorted_rows(values: Tensor, wanted: Tensor) -> Tensor:
    return values.masked_fill(wanted == 0, torch.inf).argsort(dim=0, stable=True)


@both_dtypes
@given(st.integers(1, 70), st.data())
def test_rows_are_those_of_a_sort(dtype: torch.dtype, size: int, data: st.DataObject) -> None:
    draw = torch.Generator().manual_seed(data.draw(st.integers(0, 2**31)))
    kept = data.draw(st.integers(1, size))
    values = 49 * torch.rand(size, 3, 11, dtype=dtype, generator=draw)
    wanted = torch.rand(size, 3, 11, generator=draw).lt(0.6).to(dtype)
    ours = smallest(values, 1 - wanted, kept)
    assert ours.shape == (kept, 3, 11)
    meant = torch.arange(kept).view(-1, 1, 1) < wanted.sum(0)
    # Neighbours that float32 can hardly tell apart may come either way round.
    ordered = (values * wanted).gather(0, ours.long())
    truth = (values * wanted).gather(0, sorted_rows(values, wanted)[:kept])
    assert torch.allclose(ordered[meant], truth[meant], rtol=2e-5, atol=0)


@both_dtypes
def test_equal_entries_keep_their_order(dtype: torch.dtype) -> None:
    values = torch.tensor([[3.0], [1.0], [3.0], [0.0], [3.0]], dtype=dtype)
    assert smallest(values, torch.zeros_like(values), 5).flatten().tolist() == [3, 1, 0, 2, 4]


def test_unwanted_entries_come_last() -> None:
    values, unwanted = torch.tensor([[0.0], [5.0], [1e9]]), torch.tensor([[1.0], [0.0], [0.0]])
    assert smallest(values, unwanted, 3).flatten().tolist() == [1, 2, 0]


@both_dtypes
@pytest.mark.parametrize("kept", [1, 2, 7, 24])
def test_few_columns_are_sorted_as_among_many(dtype: torch.dtype, kept: int) -> None:
    draw = torch.Generator().manual_seed(1)
    values = torch.rand(24, 2, 1003, dtype=dtype, generator=draw).mul_(30).round_()
    unwanted = torch.rand(24, 2, 1003, generator=draw).lt(0.3).to(dtype)
    many, few = smallest(values, unwanted, kept), smallest(values[..., :5], unwanted[..., :5], kept)
    assert torch.equal(many[..., :5], few)


def test_columns_do_not_depend_on_one_another() -> None:
    draw = torch.Generator().manual_seed(0)
    values = torch.rand(24, 1003, generator=draw)
    together = smallest(values, torch.zeros_like(values), 7)
    for column in (0, 500, 1002):
        alone = values[:, column : column + 1]
        assert torch.equal(smallest(alone, torch.zeros_like(alone), 7), together[:, column : column + 1])
