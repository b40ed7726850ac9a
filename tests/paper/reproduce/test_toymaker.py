import numpy as np
import pytest
from programs import read_csv

from coil_paper.reproduce.toymaker import Figure6, Table1, most_explained


def test_table_1_solves_the_bellman_equation_next_to_the_paper(tmp_path):
    page = Table1().make(tmp_path / "t")
    good, poor = 7640 / 181, 5840 / 181  # by hand, with advertising
    exact = [6 + 0.95 * (good + poor) / 2, good, -3 + 0.95 * (0.4 * good + 0.6 * poor), poor]
    rows = read_csv(tmp_path / "t.csv")
    assert [float(row["ours"]) for row in rows] == pytest.approx(exact, abs=1e-8)
    assert [float(row["paper"]) for row in rows] == [41.37, 42.21, 31.42, 32.26]
    assert "| unsuccessful toy | advertising    | 32.2652 |   32.27 | 32.26 |    +0.0052 |" in page
    assert "**did not hold up**: 1 of 4 values, off by 0.0109 at most" in page
    assert (tmp_path / "t.png").exists()


@pytest.mark.parametrize(
    ("differences", "explained"),
    [
        ([0.0, 0.0, 0.0], 3),
        ([0.1, 0.105, 0.3], 2),
        ([0.0, 0.02, 0.04], 1),
        ([0.0, 0.004, 0.008, 0.012], 3),
    ],
)
def test_one_shift_explains_differences_within_rounding(differences, explained):
    assert most_explained(np.array(differences)) == explained


def test_figure_6_has_both_values_after_each_iteration(tmp_path):
    page = Figure6(iterations=100).make(tmp_path / "f")
    rows = [[float(value) for value in row.values()] for row in read_csv(tmp_path / "f.csv")]
    assert [row[0] for row in rows] == list(range(101))
    assert rows[0][1:3] == [0, 0]
    assert rows[1][1:3] == pytest.approx([6, -3])  # the best immediate reward
    assert rows[100][1:3] == pytest.approx([7640 / 181, 5840 / 181], rel=0.01)
    assert "After 80 iterations V is 41.58 of 42.21, 31.64 of 32.27." in page
    assert "|                  2.0% |         80 | about 80 |" in page
    assert (tmp_path / "f.png").exists()


def test_values_out_of_range_are_rejected():
    with pytest.raises(ValueError, match="iterations=0 must be at least 1"):
        Figure6(0)
