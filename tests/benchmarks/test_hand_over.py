"""Rules by which a policy is handed over in place of its guide."""

import numpy as np
import pytest

from benchmarks.hand_over import RULES, SHIFTS, rows_of


@pytest.mark.parametrize("rule", RULES)
def test_equal_policies_are_handed_over_as_often_as_a_rule_allows(rule):
    drawn = np.random.default_rng(0).normal(size=(20_000, 8))
    # The higher mean; t of 7 degrees of freedom above 1, and its 95 % quantile; 1 / EVIDENCE.
    most = {"higher mean": 0.51, "better by a standard error": 0.18, "better at 5 %": 0.055}
    assert RULES[rule](drawn).mean() <= most.get(rule, 0.05)


@pytest.mark.parametrize("rule", RULES)
def test_clear_differences_are_seen(rule):
    drawn = np.random.default_rng(0).normal(size=(1_000, 32))
    assert RULES[rule](drawn + 2).mean() > 0.99
    assert RULES[rule](drawn - 2).mean() < 0.001


def test_without_noise_nothing_is_lost():
    for row in rows_of([np.full(20, 0.5)]):
        if row["cases"] >= 8:  # before that the sequential test cannot be sure
            assert row["regret"] == 0
            assert [row[f"{shift:+.0%}"] for shift in SHIFTS] == [1, 1, 1, 0, 0, 0, 0]
