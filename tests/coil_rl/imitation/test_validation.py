import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.linear_model import LinearRegression
from sklearn.metrics import r2_score
from sklearn.model_selection import LeaveOneGroupOut, cross_val_predict
from sklearn.tree import DecisionTreeRegressor

from coil_rl.errors import UserError
from coil_rl.imitation import Sklearn
from coil_rl.imitation.validation import cross_validated, group_splits, scores


@given(st.lists(st.integers(0, 30), min_size=2, max_size=80).filter(lambda groups: len(set(groups)) > 1))
def test_a_track_is_never_on_both_sides_and_every_sample_is_tested_once(groups):
    groups = torch.tensor(groups)
    splits = group_splits(groups)
    assert len(splits) == min(len(groups.unique()), 10)
    for train, test in splits:
        assert not set(groups[train].tolist()) & set(groups[test].tolist())
        assert len(train) + len(test) == len(groups)
    tested = np.concatenate([test for _, test in splits])
    assert sorted(tested) == list(range(len(groups)))


def sines(rows=90):
    """Three tracks on which a line fits differently well."""
    x = torch.linspace(0, 6, rows).unsqueeze(-1)
    return x, x.sin(), torch.arange(3).repeat_interleave(rows // 3)


def test_error_on_left_out_tracks_is_that_of_scikit_learn():
    x, y, groups = sines()
    found = cross_validated(Sklearn(LinearRegression()), x, y, groups)
    said = cross_val_predict(LinearRegression(), x, y, groups=groups, cv=LeaveOneGroupOut())
    assert found["mse_by_track"] == pytest.approx(((said - y.numpy()) ** 2).mean(), rel=1e-4)
    assert found["r2_by_track"] == pytest.approx(r2_score(y, said), rel=1e-4)


def test_new_tracks_are_harder_than_samples_drawn_at_random():
    # For a random sample there is nearly the same one to look up, for one of a new track there is none.
    found = cross_validated(Sklearn(DecisionTreeRegressor()), *sines())
    assert found["mse_random_split"] < 0.01
    assert found["mse_by_track"] > 0.1


def test_the_seed_draws_the_random_split_and_nothing_else():
    one, other, again = (cross_validated(Sklearn(LinearRegression()), *sines(), seed=seed) for seed in (0, 1, 0))
    assert one == again
    assert one["mse_random_split"] != other["mse_random_split"]
    assert one["mse_by_track"] == other["mse_by_track"]


def test_r2_is_the_explained_share_of_the_variance():
    true, said = torch.tensor([[0.0], [1.0], [2.0]]), torch.tensor([[0.0], [1.0], [1.0]])
    assert scores([said], [true], "x") == pytest.approx({"mse_x": 1 / 3, "r2_x": 0.5})
    assert scores([said[:1], said[1:]], [true[:1], true[1:]], "x") == scores([said], [true], "x")
    assert scores([true[:2]], [torch.ones(2, 1)], "x") == {"mse_x": 0.5, "r2_x": 0.0}


def test_without_tracks_only_the_random_split_is_reported():
    x, y, groups = sines()
    assert set(cross_validated(Sklearn(LinearRegression()), x, y)) == {"mse_random_split", "r2_random_split"}
    with pytest.raises(UserError, match="from one track"):
        cross_validated(Sklearn(LinearRegression()), x, y, torch.zeros_like(groups))
    with pytest.raises(UserError, match="9 samples are too few"):
        cross_validated(Sklearn(LinearRegression()), x[:9], y[:9])
