import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from coil_rl.envs.sorting import append, first_come, smallest

both_dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


@both_dtypes
@given(st.integers(1, 70), st.data())
def test_smallest_agrees_with_argsort(dtype, size, data):
    draw = torch.Generator().manual_seed(data.draw(st.integers(0, 2**31)))
    k = data.draw(st.integers(1, size))
    values = 49 * torch.rand(size, 3, 11, dtype=dtype, generator=draw)
    valid = torch.rand(size, 3, 11, generator=draw).lt(0.6).to(dtype)
    rows = smallest(values, 1 - valid, k)
    assert rows.shape == (k, 3, 11)
    truth = values.masked_fill(valid == 0, torch.inf).argsort(dim=0, stable=True)[:k]
    real = torch.arange(k).view(-1, 1, 1) < valid.sum(0)
    # Values that differ in the last bits of a float32 may come in either order.
    selected, expected = ((values * valid).gather(0, index.long()) for index in (rows, truth))
    assert torch.allclose(selected[real], expected[real], rtol=2e-5, atol=0)


@both_dtypes
def test_equal_entries_keep_their_order(dtype):
    values = torch.tensor([[3.0], [1.0], [3.0], [0.0], [3.0]], dtype=dtype)
    assert smallest(values, torch.zeros_like(values), 5).flatten().tolist() == [3, 1, 0, 2, 4]


def test_first_come_keeps_what_conflicts_with_no_kept_entry_before_it():
    values = torch.tensor([[0.0], [0.5], [1.2], [5.0], [1.9], [5.5]])
    eligible = torch.tensor([[True], [True], [True], [False], [True], [True]])
    conflict = (values.unsqueeze(0) - values.unsqueeze(1)).abs() < 1
    # 0.5 is too near to 0, 1.9 to 1.2; 5.5 is near to 5 alone, which is not eligible.
    kept = first_come(eligible, conflict).flatten().tolist()
    assert kept == [True, False, True, False, False, True]


def test_append_adds_selected_points_in_order_as_far_as_there_is_room():
    points, more = torch.zeros(1, 4, 2), torch.tensor([[[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]])
    selected = torch.tensor([[True, False], [False, True], [True, True]])
    longer, count = append(points, torch.tensor([1, 3]), more, selected)
    assert count.tolist() == [3, 4]
    assert longer[0].T.tolist() == [[0, 1, 3, 0], [0, 0, 0, 2]]
    assert points.eq(0).all()
