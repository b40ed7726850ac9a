"""The rule of the recommendation, on tables that were made up."""

from dataclasses import replace

import numpy as np
import pytest

from coil_rl.comparison.entry import Entry, difference
from coil_rl.comparison.verdict import NOTHING, verdict

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


ANCHORED = "coil_anchored"
RULES = {
    "less than a percent is no gain": ("guide", {"guide": 98.5, "ppo": 0.0, ANCHORED: 99.0}),
    "a policy is better than a tuned guide": (ANCHORED, {"tune": 60, "ppo": 20, ANCHORED: 80}),
    "another mean is higher": (ANCHORED, {"ppo": [10, 200], ANCHORED: [80, 82], "residual": 70}),
    "doing nothing is better than the guide only": ("ppo", {"guide": 20, "zero": 60, "ppo": 90}),
}


@pytest.mark.parametrize("rule", RULES)
def test_what_costs_nothing_wins_unless_something_is_clearly_better(rule):
    use, means = RULES[rule]
    found = verdict(entries(**means))
    assert (found.use, found.train) == (use, ANCHORED if ANCHORED in means else "")


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
    assert found.sentences[0].startswith("Your guide is the wrong way round. Turn its action round")
    assert "the opposite has 89.0, the guide -90.0" in found.sentences[0]


@pytest.mark.parametrize(("opposite", "is_reversed"), [(55.2, False), (56.2, True)])
def test_opposite_must_be_better_by_a_tenth_of_the_way_from_random_to_the_best(
    opposite, is_reversed
):
    found = verdict(entries(guide=50.0, opposite=opposite))
    assert (found.use == "opposite") == found.wrong_way_round == is_reversed


def test_policy_may_be_better_than_the_opposite_of_a_reversed_guide():
    found = verdict(entries(guide=-90.0, opposite=89.0, ppo=0.0, coil_anchored=95.0))
    assert found.use == "coil_anchored"
    assert found.sentences[0].startswith("Your guide is the wrong way round. Use coil_anchored")


def test_ppo_is_recommended_where_it_is_best_and_anchored_sac_is_to_be_trained():
    learned = {"coil_anchored": [70.0, 71.0], "coil_anchored_sac": 20.0}
    found = verdict(entries(guide=20.0, ppo=[90.0, 92.0], **learned))
    assert (found.use, found.train) == ("ppo", "coil_anchored_sac")
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


def test_failed_arms_are_named_as_undecided():
    found = verdict(entries(coil_anchored=90.0), failed=["ppo"])
    assert "what ppo would have reached, which failed" in found.sentences[2]
    found = verdict(entries(), failed=["ppo", "coil_anchored"])
    assert found.use == "guide"
    assert found.sentences[2].endswith("which failed. No training finished.")


def test_good_guide_is_kept_where_the_best_mean_is_of_a_policy_with_one_bad_seed():
    found = verdict(entries(guide=60.0, ppo=[-20.0, 180.0], coil_anchored=[50.0, 61.0]))
    assert (found.use, found.train) == ("guide", "coil_anchored")
    assert found.score == pytest.approx(0.75)
    assert "whether ppo" in found.sentences[2]


@pytest.mark.parametrize(
    ("name", "words"), [("zero", "Doing nothing"), ("first network", "The un")]
)
def test_doing_nothing_is_used_where_it_is_clearly_better_than_everything_else(name, words):
    low = {"zero": -120.0, "first network": -130.0}
    given = {"random": -160.0, "guide": -40.0, "opposite": -150.0, "ppo": [-90.0, -80.0]}
    found = verdict(entries(**(low | given | {name: 40.0})))
    assert (found.use, found.train) == (name, "")
    assert found.score == pytest.approx(0.6)
    first, second, _ = found.sentences
    assert first.startswith(words)
    assert (
        "40.0) is clearly better than everything else here; your guide has -40.0, at 0.6" in first
    )
    assert "+80.0" in second


@pytest.mark.parametrize(
    ("action", "words"),
    [
        ("zero actions", "Doing nothing (zero actions, 40.0) is"),
        ("the middle of the action's range", "The middle of the action's range (zero, 40.0) is"),
        ("the first choice", "The first choice (zero, 40.0) is"),
    ],
)
def test_only_zero_actions_are_called_doing_nothing(action, words):
    def said(**means):
        made = entries(**means)
        made["zero"] = replace(made["zero"], action=action)
        return verdict(made).sentences

    assert said(zero=40.0, guide=-40.0, random=-160.0, ppo=-90.0)[0].startswith(words)
    assert f"nor {action} (-7.00), nor what was" in said(zero=-7.0, guide=-5.0, ppo=-2.0)[0]


def test_guide_is_not_called_the_best_where_doing_nothing_is_as_good():
    given = {"random": -200.0, "opposite": -190.0, "zero": 0.0, "first network": 0.0}
    found = verdict(entries(guide=-80.0, ppo=-90.0, **given))
    assert found.use in ("zero", "first network")
    assert "everything else here but" in found.sentences[0]
    found = verdict(entries(guide=50.0, ppo=[40.0, 30.0], zero=[50.1]))
    assert found.use == "guide"
    assert "zero" in found.sentences[2]


def test_doing_nothing_may_be_all_that_is_better_than_random_actions():
    given = {"random": -200.0, "opposite": -220.0, "zero": -100.0, "first network": -210.0}
    found = verdict(entries(guide=-230.0, ppo=[-300.0, 0.0], **given))
    assert (found.use, found.train) == ("zero", "")
    assert "random actions (-200.0), which no guide and no trained policy" in found.sentences[0]


def variable(made, name, mean, spread):
    """Let the returns of an entry vary from case to case."""
    returns = mean + spread * np.array([1, -1, 1, -1, 1, -1, 1, -1.0])
    return made | {name: Entry(name, np.tile(returns, (len(made[name].returns), 1)))}


@pytest.mark.parametrize("mean", [-382.0, -150.0])
def test_guide_that_is_not_clearly_better_than_random_gives_way_to_a_policy_that_is(mean):
    low = {"random": -200.0, "opposite": -210.0, "zero": -220.0, "first network": -230.0}
    made = variable(entries(ppo=-100.0, coil_anchored=-101.0, **low), "guide", mean, 900.0)
    found = verdict(made)
    assert (found.use, found.train) == ("ppo", "coil_anchored")
    said = "Your guide is not clearly better than random actions (-200.0). Use ppo: -100.0"
    assert found.sentences[0].startswith(said)
    assert "guide" in found.sentences[2]


def test_only_what_is_clearly_better_than_random_is_recommended():
    generator = np.random.default_rng(0)
    names = ("guide", "opposite", "zero", "tune", "ppo", "coil_anchored", "residual")
    for _ in range(100):
        means = {name: list(generator.normal(0, 50, 2)) for name in names}
        made = entries(**means)
        for name in names:
            made = variable(made, name, made[name].mean, generator.choice([0.0, 100.0]))
        random = made["random"]
        sure = [name for name in names if difference(made[name], random).above(0)]
        found = verdict(made)
        assert found.use in (sure or [NOTHING])
        assert found.score <= 1 or not sure


def test_nothing_is_recommended_on_one_case_and_it_is_said_why():
    made = entries(guide=90.0, ppo=[80.0, 99.0])
    found = verdict({name: Entry(name, each.returns[:, :1]) for name, each in made.items()})
    assert found.use == NOTHING
    assert "no interval: one case" in found.sentences[1]
    assert "give more cases than one" in found.sentences[2]


def test_nothing_is_to_be_trained_where_no_training_finished():
    found = verdict(entries(guide=-5.0, opposite=-6.0), failed=["ppo"])
    assert (found.use, found.train) == (NOTHING, "")
    assert "no training finished" in found.sentences[0]
    assert "what made the trainings fail" in found.sentences[2]
