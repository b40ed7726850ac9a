import csv

import numpy as np
import pytest
from PIL import Image

from coil_rl.reproduce import Table1
from coil_rl.reproduce.table_1 import most_explained


def test_table_1_is_the_solution_of_the_bellman_equation_beside_what_the_paper_prints(tmp_path):
    page = Table1().make(tmp_path / "t")
    # By hand: 7640/181 and 5840/181 where the toymaker advertises.
    exact = [6 + 0.95 * (7640 + 5840) / 2 / 181, 7640 / 181, -3 + 0.95 * (0.4 * 7640 + 0.6 * 5840) / 181, 5840 / 181]
    printed = [41.37, 42.21, 31.42, 32.26]
    with (tmp_path / "t.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["ours"]) for row in rows] == pytest.approx(exact, abs=1e-8)
    assert [float(row["paper"]) for row in rows] == printed
    np.testing.assert_allclose(exact, printed, rtol=0, atol=0.011)
    assert "| unsuccessful toy | advertising    | 32.2652 |   32.27 | 32.26 |    +0.0052 |" in page
    assert "1 of 4 values round to what is printed; the largest difference is 0.0109." in page
    assert "| Advertising is worth more in both states | **held up**: by 0.8" in page
    assert "**did not hold up**: 1 of 4 values, off by 0.0109 at most" in page
    with Image.open(tmp_path / "t.png") as image:
        assert image.size == (1600, 480)


@pytest.mark.parametrize(
    ("off", "explained"),
    [([0.0, 0.0, 0.0], 3), ([0.1, 0.105, 0.3], 2), ([0.0, 0.02, 0.04], 1), ([0.0, 0.004, 0.008, 0.012], 3)],
)
def test_one_shortfall_explains_differences_that_are_no_further_apart_than_rounding_hides(off, explained):
    assert most_explained(np.array(off)) == explained


def test_a_tolerance_of_nothing_is_refused():
    with pytest.raises(ValueError, match="tolerance=0 must be more than 0"):
        Table1(0)
