"""The rule of the recommendation, on tables that were made up."""

import numpy as np
import pytest

from coil_rl.worth.verdict import NOTHING, Entry, difference, verdict

CASES = np.linspace(-1, 1, 8)  # of all entries: some cases are easier


def entries(seeds=2, **means):
    """Return entries with some means; a list has one mean for each seed."""
    given = {"guide": 50.0, "opposite": -50.0, "zero": 0.0, "random": 0.0, "first network": 0.0}
    made = {}
    for number, (name, mean) in enumerate((given | means).items()):
        of_seeds = mean if isinstance(mean, list) else [mean] * (seeds if name in means else 1)
        noise = 0.1 * np.sin(7.0 * number + 13.0 * np.arange(8))
        returns = np.array(of_seeds)[:, None] + CASES + noise - noise.mean()
        made[name] = Entry(name, returns)
    return made


def test_guide_at_99_percent_of_what_was_reached_is_left():
    found = verdict(entries(guide=99.3, ppo=40.0, coil_anchored=100.0))
    assert (found.use, found.train) == ("guide", "coil_anchored")
    assert found.sentences[0].startswith("Leave it: your guide is at 0.99 of what was reached")
    assert "+59.3" in found.sentences[1]


def test_guide_is_kept_where_nothing_is_clearly_better():
    found = verdict(entries(guide=80.0, ppo=[40.0, 120.0], coil_anchored=[70.0, 100.0]))
    assert found.use == "guide"
    assert found.sentences[0].startswith("Keep your guide (80.0): it is at 0.94 of what")
    assert "coil_anchored" in found.sentences[2]


def test_guide_that_is_reversed_is_said_to_be_the_wrong_way_round():
    found = verdict(entries(guide=-90.0, opposite=89.0, ppo=0.0, coil_anchored=88.0))
    assert found.wrong_way_round
    assert (found.use, found.train) == ("opposite", "coil_anchored")
    assert found.sentences[0] == (
        "Your guide is the wrong way round. Turn its action round: the opposite has 89.0, the "
        "guide -90.0."
    )


def test_policy_may_be_better_than_the_opposite_of_a_reversed_guide():
    found = verdict(entries(guide=-90.0, opposite=89.0, ppo=0.0, coil_anchored=95.0))
    assert found.use == "coil_anchored"
    assert found.sentences[0].startswith("Your guide is the wrong way round. Use coil_anchored")


def test_ppo_is_recommended_where_it_is_best():
    found = verdict(entries(guide=20.0, ppo=[90.0, 92.0], coil_anchored=[70.0, 71.0]))
    assert (found.use, found.train) == ("ppo", "ppo")
    assert "over the guide" in found.sentences[1]
    assert "over PPO" not in found.sentences[1]


def test_anchored_policy_is_recommended_where_it_is_best():
    found = verdict(entries(ppo=[10.0, 20.0], coil_anchored=[90.0, 92.0], residual=[80.0, 85.0]))
    assert found.use == found.train == "coil_anchored"
    assert "+41.0" in found.sentences[1]
    assert "+76.0" in found.sentences[1]
    assert "those of ppo differ by 10.0, the most here" in found.sentences[2]


def test_what_is_not_clearly_worse_is_undecided():
    found = verdict(entries(ppo=[88.0, 91.0], coil_anchored=[90.0, 92.0]))
    assert found.use == "coil_anchored"
    assert "whether ppo would be as good or better" not in found.sentences[2]
    found = verdict(entries(ppo=[93.0, 88.0], coil_anchored=[90.0, 92.0]))
    assert "whether ppo would be as good or better" in found.sentences[2]


def test_nothing_is_recommended_where_nothing_is_better_than_random_actions():
    found = verdict(entries(guide=-5.0, opposite=-6.0, ppo=[-1.0, 1.0], coil_anchored=[0.3, -4.0]))
    assert found.use == NOTHING
    assert "clearly better than random actions" in found.sentences[0]
    assert len(found.sentences) == 3


def test_tuned_guide_is_recommended_where_it_is_clearly_better():
    found = verdict(entries(tune=95.0, ppo=60.0, coil_anchored=70.0))
    assert (found.use, found.train) == ("tune", "tune")
    assert "tuned numbers: 95.0 instead of 50.0" in found.sentences[0]


def test_tuned_guide_is_not_recommended_where_a_policy_is_clearly_better():
    assert verdict(entries(tune=60.0, ppo=20.0, coil_anchored=80.0)).use == "coil_anchored"


def test_gain_of_less_than_a_percent_is_none():
    assert verdict(entries(guide=98.5, ppo=0.0, coil_anchored=99.0)).use == "guide"


def test_failed_arms_are_named_as_undecided():
    found = verdict(entries(coil_anchored=90.0), failed=["ppo"])
    assert "what ppo would have reached, which failed" in found.sentences[2]
    assert verdict(entries(), failed=["ppo", "coil_anchored"]).use == "guide"


def test_one_seed_and_one_case_are_never_clear_of_themselves():
    one, other = Entry("one", np.array([[1.0]])), Entry("other", np.array([[1.0]]))
    assert not difference(one, other).above(0.0)


@pytest.mark.parametrize("seeds", [1, 2, 3])
def test_difference_is_paired_by_case(seeds):
    one = Entry("one", np.tile(100 * CASES + 1, (seeds, 1)))
    found = difference(one, Entry("other", 100 * CASES[None]))
    assert (found.mean, found.low, found.high) == pytest.approx((1, 1, 1))
    assert found.above(0.5)
    assert not found.above(2.0)
