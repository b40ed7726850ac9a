import pytest
from run_folders import driven, make_run, make_sweep

from coil_rl.report.comparison import compare
from coil_rl.report.paired import paired
from coil_rl.report.runs import read_runs


def by_name(folder):
    found = compare(read_runs([folder]))
    return {group.title: group for group in (*found.guides, *found.agents)}


def test_pairs_are_of_the_seeds_that_both_have_whatever_the_order_of_their_folders(tmp_path):
    for place, seed in enumerate([2, 0, 1]):
        make_run(tmp_path / f"a{place}", "a", seed, driven("a", {"x": 10.0 * seed, "y": 5.0}))
    for seed in (1, 2, 3):
        make_run(tmp_path / f"b{seed}", "b", seed, driven("b", {"x": 10.0 * seed - 4, "y": 5.0}))
    groups = by_name(tmp_path)
    found = paired(groups["a"], groups["b"])
    assert found.seeds == 2
    assert found.difference == (2, 2, 2), "4 more on x and as much on y, with both"
    assert found.better == (0.75, 0.75, 0.75)
    assert paired(groups["b"], groups["a"]).difference[0] == -2


@pytest.fixture
def sweep(tmp_path):
    return make_sweep(tmp_path / "sweep")


def test_a_guide_is_the_same_for_every_seed(sweep):
    groups = by_name(sweep)
    found = paired(groups["coil"], groups["guide"])
    assert (found.seeds, found.better[0]) == (3, 1)
    assert found.difference[0] == pytest.approx(21)
    assert found.difference[1] < 21 < found.difference[2]
    assert paired(groups["coil"], groups["ppo"], "smoothness").difference[0] == pytest.approx(0.1)


def test_what_cannot_be_paired_is_not(sweep, tmp_path):
    groups = by_name(sweep)
    assert paired(groups["coil, zeroed"], groups["coil"], "lap_time") is None, "no lap was finished"
    make_run(tmp_path / "other" / "9", "coil", 9, driven("coil", {"a": 500.0, "b": 600.0}))
    make_run(tmp_path / "other" / "elsewhere", "elsewhere", 0, driven("elsewhere", {"c": 1.0}))
    others = by_name(tmp_path / "other")
    assert paired(others["coil"], groups["ppo"]) is None, "no common seed"
    assert paired(others["elsewhere"], groups["ppo"]) is None, "other tracks"
