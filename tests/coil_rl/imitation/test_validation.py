import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.linear_model import LinearRegression
from sklearn.metrics import r2_score
from sklearn.model_selection import LeaveOneGroupOut, cross_val_predict

from coil_rl.errors import UserError
from coil_rl.imitation import LinearRegressor
from coil_rl.imitation.validation import cross_validate, group_splits


@pytest.mark.slow
@given(
    st.lists(st.integers(0, 30), min_size=2, max_size=80).filter(
        lambda groups: len(set(groups)) > 1
    )
)
def test_no_track_is_on_both_sides_and_every_sample_is_tested_once(groups):
    groups = torch.tensor(groups)
    splits = group_splits(groups)
    assert len(splits) == min(len(groups.unique()), 10)
    for train, test in splits:
        assert not set(groups[train].tolist()) & set(groups[test].tolist())
        assert len(train) + len(test) == len(groups)
    tested = np.concatenate([test for _, test in splits])
    assert sorted(tested) == list(range(len(groups)))


def sines(rows=90):
    """Samples of a sine on three tracks."""
    x = torch.linspace(0, 6, rows).unsqueeze(-1)
    return x, x.sin(), torch.arange(3).repeat_interleave(rows // 3)


def test_error_on_left_out_tracks_equals_that_of_scikit_learn_for_every_seed():
    x, y, groups = sines()
    metrics, other = (cross_validate(LinearRegressor(), x, y, groups, seed=k) for k in (0, 1))
    assert metrics["mse_by_track"] == other["mse_by_track"]
    assert metrics["mse_random_split"] != other["mse_random_split"]
    predicted = cross_val_predict(LinearRegression(), x, y, groups=groups, cv=LeaveOneGroupOut())
    assert metrics["mse_by_track"] == pytest.approx(((predicted - y.numpy()) ** 2).mean(), rel=1e-4)
    assert metrics["r2_by_track"] == pytest.approx(r2_score(y, predicted), rel=1e-4)


def test_without_tracks_there_is_a_random_split_only():
    x, y, groups = sines()
    assert set(cross_validate(LinearRegressor(), x, y)) == {"mse_random_split", "r2_random_split"}
    with pytest.raises(UserError, match="from one track"):
        cross_validate(LinearRegressor(), x, y, torch.zeros_like(groups))
    with pytest.raises(UserError, match="9 samples are too few"):
        cross_validate(LinearRegressor(), x[:9], y[:9])
