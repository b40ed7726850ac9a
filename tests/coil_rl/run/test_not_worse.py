"""The sentence whether a policy is not worse than its guide."""

import pytest

from coil_rl.report.statistics import mean_interval
from coil_rl.report.table import return_format
from coil_rl.run.evaluation import EvaluationResult
from coil_rl.run.judge import not_worse


def result_of(rewards):
    return EvaluationResult([{"reward": reward, "steps": 1} for reward in rewards])


@pytest.mark.parametrize(
    ("agent", "answer"),
    [
        ([101, 102, 103], "yes"),
        ([99.5, 99.5, 99.5], "yes"),
        ([98.5, 98.5, 98.5], "no"),
        ([90, 91, 92], "no"),
        ([80, 120, 100], "undecided"),
        ([98.9, 99.1, 99.2], "undecided, but worse"),
    ],
)
@pytest.mark.parametrize("zero", [0, -100, -1_000_000])  # that of the rewards means nothing
def test_agent_is_not_worse_if_the_whole_interval_is_above_one_percent_less(agent, answer, zero):
    mine, guide = ([zero + reward for reward in each] for each in (agent, [100, 100, 100]))
    (sentence,) = not_worse(result_of(mine), result_of(guide), "guide", chance=zero)
    assert f"Not worse than guide on these 3 cases: {answer} " in sentence
    _, low, high = mean_interval([reward - 100 for reward in agent])
    spec = return_format([low, high])
    assert f"{low:+{spec}} to {high:+{spec}}" in sentence
    assert "above -1.00, 1 % of" in sentence


@pytest.mark.parametrize(
    ("agent", "interval", "chance", "limit"),
    [
        ([100.1, 90.2], "-0.485 to +0.785", 94, "-0.0100"),
        ([110, 102], "-1.7 to +23.7", 94, "-0.0100"),  # not 0
        ([100.1, 90.2], "-0.485 to +0.785", 95, "0.0"),
    ],
)
def test_small_limit_is_shown_beside_large_returns(agent, interval, chance, limit):
    (sentence,) = not_worse(result_of(agent), result_of([100, 90]), "guide", chance)
    said = f"(reward minus the guide's: {interval}, 95 % interval; yes means above {limit},"
    assert said in sentence


def test_agent_with_the_returns_of_its_guide_has_no_interval():
    (sentence,) = not_worse(result_of([100, 90]), result_of([100, 90]), "guide", chance=0)
    assert sentence == (
        "Not worse than guide on these 2 cases: yes, the return is the same in each of them."
    )
