import numpy as np
import pytest
from programs import read_csv
from reproduced_runs import cells

from coil_paper.reproduce.tabular_claim import TabularCoil

SMALL = {"states": 6, "actions": 2, "classes": 2, "steps": [50, 500, 5_000]}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The page, the rows of the CSV by view and guide, and the output path."""
    stem = tmp_path_factory.mktemp("claim") / "c"
    page = TabularCoil(worlds=3, **SMALL).make(stem)
    groups = {}
    for row in read_csv(stem.with_suffix(".csv")):
        groups.setdefault((row["view"], row["guide"]), []).append(row)
    return page, groups, stem


def column(rows, key):
    return np.array([float(row[key]) for row in rows]).reshape(3, 3)


@pytest.mark.slow
def test_scores_of_the_guides_are_ordered_and_at_most_optimal(made):
    _, groups, _ = made
    assert {guide for _, guide in groups} == {"optimal", "noisy (20%)", "random", "worst"}
    for (_, guide), rows in groups.items():
        own, coil, plain = (column(rows, f"{who}_score") for who in ("guide", "coil", "plain"))
        assert max(coil.max(), plain.max(), own.max()) <= 1 + 1e-9
        if guide in ("optimal", "random"):
            np.testing.assert_allclose(own, guide == "optimal", atol=1e-9)
        assert (own.max(axis=1) == own.min(axis=1)).all()
    assert (column(groups["state", "worst"], "guide_score") < 0).all()
    noisy = column(groups["state", "noisy (20%)"], "guide_score")
    assert ((noisy > 0) & (noisy < 1)).all()


def test_deterministic_advice_changes_nothing_with_the_whole_state(made):
    _, groups, _ = made
    for guide in ("optimal", "worst"):
        coil, plain = (column(groups["state", guide], key) for key in ("coil_score", "plain_score"))
        np.testing.assert_allclose(coil, plain, rtol=0, atol=1e-12)
    coil, plain = (column(groups["state", "random"], key) for key in ("coil_score", "plain_score"))
    assert np.abs(coil - plain).max() > 1e-3


def test_the_page_counts_the_worlds_in_which_coil_reaches_its_guide(made):
    page, groups, stem = made
    rows = groups["class", "optimal"]
    reached = (column(rows, "coil_score") >= 1 - 1e-9).mean(axis=0)
    line = next(line for line in page.splitlines() if "one of 2 classes | optimal" in line)
    assert [f"{share:.0%}" for share in reached[[0, 2]]] == cells(line)[5:7]
    pairs = [(column(rows, "coil_score"), column(rows, "guide_score")) for rows in groups.values()]
    reached = sum((coil[:, -1] >= own[:, -1] - 1e-9).sum() for coil, own in pairs)
    assert f"**: in {reached} of 24 worlds, guides and views |" in page
    assert stem.with_suffix(".png").exists()


def test_worlds_do_not_depend_on_their_number(made, tmp_path):
    TabularCoil(worlds=1, **SMALL).make(tmp_path / "c")
    again = (tmp_path / "c.csv").read_text()
    assert made[2].with_suffix(".csv").read_text().startswith(again)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"worlds": 0}, "worlds=0 must be at least 1"),
        ({"episode_steps": 0}, "episode_steps=0 must be at least 1"),
        ({"states": 2}, "states=2 must be at least 3"),
        ({"states": 5, "classes": 6}, "at least classes=6"),
        ({"noise": 1.5}, "noise=1.5 must be at most 1"),
        ({"epsilon": 0}, "epsilon=0 must be more than 0"),
        ({"power": 0.5}, "power=0.5 must be more than 0.5"),
        ({"steps": [3, 2]}, "must be increasing integers from 1"),
        ({"steps": [0, 2]}, "must be increasing integers from 1"),
    ],
)
def test_options_out_of_range_are_rejected(options, message):
    with pytest.raises(ValueError, match=message):
        TabularCoil(**options)
