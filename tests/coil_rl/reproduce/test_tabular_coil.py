import csv

import numpy as np
import pytest
from PIL import Image

from coil_rl.reproduce import TabularCoil


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A small one: its page, its numbers by what is seen and guide [worlds, steps], and where it is."""
    stem = tmp_path_factory.mktemp("claim") / "c"
    page = TabularCoil(worlds=3, states=6, actions=2, kinds=2, steps=[50, 500, 5_000]).make(stem)
    with stem.with_suffix(".csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    groups = {}
    for row in rows:
        groups.setdefault((row["sees"], row["guide"]), []).append(row)
    return page, groups, stem


def column(rows, key):
    return np.array([float(row[key]) for row in rows]).reshape(3, 3)


def test_scores_are_of_guides_as_good_as_their_names_and_below_the_optimum(made):
    _, groups, _ = made
    assert {guide for _, guide in groups} == {"optimal", "noisy (20%)", "random", "worst"}
    for (_, guide), rows in groups.items():
        own, coil, plain = (column(rows, f"{who}_score") for who in ("guide", "coil", "plain"))
        assert max(coil.max(), plain.max(), own.max()) <= 1 + 1e-9
        if guide in ("optimal", "random"):
            np.testing.assert_allclose(own, guide == "optimal", atol=1e-9)
        assert (own.max(axis=1) == own.min(axis=1)).all()
    worst, noisy = (column(groups["all", guide], "guide_score") for guide in ("worst", "noisy (20%)"))
    assert (worst < 0).all()
    assert ((noisy > 0) & (noisy < 1)).all()


def test_with_the_whole_state_a_guide_that_never_changes_its_mind_changes_nothing(made):
    _, groups, _ = made
    for guide in ("optimal", "worst"):
        coil, plain = (column(groups["all", guide], key) for key in ("coil_score", "plain_score"))
        np.testing.assert_allclose(coil, plain, rtol=0, atol=1e-12)
    coil, plain = (column(groups["all", "random"], key) for key in ("coil_score", "plain_score"))
    assert np.abs(coil - plain).max() > 1e-3


def test_where_states_look_alike_an_optimal_guide_helps(made):
    _, groups, _ = made
    rows = groups["kinds", "optimal"]
    assert column(rows, "coil_score")[:, -1].mean() > column(rows, "plain_score")[:, -1].mean() + 0.1


def test_the_page_counts_the_worlds_where_coil_is_at_least_its_guide(made):
    page, groups, stem = made
    rows = groups["kinds", "optimal"]
    reached = (column(rows, "coil_score") >= 1 - 1e-9).mean(axis=0)
    line = next(line for line in page.splitlines() if "one of 2 kinds | optimal" in line)
    assert [f"{share:.0%}" for share in reached[[0, 2]]] == [cell.strip() for cell in line.split("|")[6:8]]
    assert "≥ guide, 50 steps | ≥ guide, 5,000 steps" in page
    assert "means over 3 random worlds" in page
    pairs = [(column(rows, "coil_score"), column(rows, "guide_score")) for rows in groups.values()]
    reached = sum((coil[:, -1] >= own[:, -1] - 1e-9).sum() for coil, own in pairs)
    assert f"**: in {reached} of 24 worlds, guides and views |" in page
    with Image.open(stem.with_suffix(".png")) as image:
        assert image.size == (1600, 1120)


def test_it_is_the_same_each_time(made, tmp_path):
    TabularCoil(worlds=1, states=6, actions=2, kinds=2, steps=[50, 500, 5_000]).make(tmp_path / "c")
    again = (tmp_path / "c.csv").read_text()
    assert made[2].with_suffix(".csv").read_text().startswith(again)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"worlds": 0}, "worlds=0 must be at least 1"),
        ({"episode": 0}, "episode=0 must be at least 1"),
        ({"states": 2}, "states=2 must be at least 3"),
        ({"states": 5, "kinds": 6}, "as many as there are kinds"),
        ({"noise": 1.5}, "noise=1.5 must be between 0 and 1"),
        ({"epsilon": 0}, "epsilon=0 more than 0"),
        ({"power": 0.5}, "power=0.5 more than 0.5"),
        ({"steps": []}, "must be whole numbers from 1 that grow"),
        ({"steps": [3, 2]}, "must be whole numbers from 1 that grow"),
        ({"steps": [0, 2]}, "must be whole numbers from 1 that grow"),
    ],
)
def test_choices_that_make_no_sense_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        TabularCoil(**options)
