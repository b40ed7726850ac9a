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


NAMES = {"A": "coil_anchored", "S": "coil_anchored_sac", "N": "first network", "-": ""}
NAMES |= {"nothing": NOTHING}
BAD = "random=-160 guide=-40 opposite=-150 ppo=-90,-80"
LOW = "random=-200 opposite=-190 zero=0 N=0"
WORSE = "random=-200 opposite=-220 zero=-100 N=-210"
CLEAR = "1 40.0) is clearly better than everything else here; your guide has -40.0, at 0.6"
# Means, of each seed where there are several; what is used and trained; and what a sentence says:
# its number, and a text, in which bars are begin and end. What it does not say begins with "!".
RULES = [
    # What costs nothing is used unless something is clearly better; a percent is no gain.
    ("guide=98.5 ppo=0 A=99", "guide A", "1 guide"),
    ("guide=99.3 ppo=40 A=100", "guide A", "1 |Leave it: your guide is at 0.99 of what was"),
    ("guide=99.3 ppo=40 A=100", "guide A", "2 +59.3"),
    ("guide=80 ppo=40,120 A=70,100", "guide A", "1 |Keep your guide (80.0): it is at 0.94"),
    ("guide=80 ppo=40,120 A=70,100", "guide A", "3 coil_anchored"),
    ("guide=60 ppo=-20,180 A=50,61", "guide A", "3 whether ppo"),  # one bad seed
    ("guide=60 ppo=-20,180 A=50,61", "guide A", "score 0.75"),
    ("ppo=10,200 A=80,82 residual=70", "A A", "1 coil_anchored"),  # another mean is higher
    ("tune=95 ppo=60 A=70", "tune tune", "1 tuned numbers: 95.0 instead of 50.0"),
    ("tune=60 ppo=20 A=80", "A A", "1 coil_anchored"),
    # A reversed guide is the wrong way round, and a policy may be better than its opposite.
    (
        "guide=-90 opposite=89 ppo=0 A=88",
        "opposite A",
        "1 |Your guide is the wrong way round. T",
    ),
    ("guide=-90 opposite=89 ppo=0 A=88", "opposite A", "1 the opposite has 89.0, the guide -90.0"),
    ("guide=-90 opposite=89 ppo=0 A=95", "A A", "1 |Your guide is the wrong way round. Use coil_a"),
    # A policy is best: over what, and how much its seeds say.
    ("guide=20 ppo=90,92 A=70,71 S=20", "ppo S", "2 over the guide"),
    ("guide=20 ppo=90,92 A=70,71 S=20", "ppo S", "2 !over PPO"),
    ("ppo=10,20 A=90,92 residual=80,85", "A A", "2 +41.0"),
    ("ppo=10,20 A=90,92 residual=80,85", "A A", "2 +76.0"),
    ("ppo=10,20 A=90,92 residual=80,85", "A A", "3 those of ppo differ by 10.0, the most"),
    ("ppo=88,91 A=90,92", "A A", "3 !whether ppo would be as good or better"),
    ("ppo=93,88 A=90,92", "A A", "3 whether ppo would be as good or better"),
    ("A=90 failed=ppo", "A A", "3 what ppo would have reached, which failed"),
    ("failed=ppo,A", "guide -", "3 which failed. No training finished.|"),
    # Doing nothing is used where it is clearly better than everything else.
    ("guide=20 zero=60 ppo=90", "ppo -", "1 ppo"),
    (f"{BAD} zero=40 N=-130", "zero -", CLEAR),
    (f"{BAD} zero=40 N=-130", "zero -", "1 |Doing nothing"),
    (f"{BAD} zero=40 N=-130", "zero -", "2 +80.0"),
    (f"{BAD} zero=40 N=-130", "zero -", "score 0.6"),
    (f"{BAD} zero=-120 N=40", "N -", CLEAR),
    (f"{BAD} zero=-120 N=40", "N -", "1 |The un"),
    (f"{BAD} zero=-120 N=40", "N -", "2 +80.0"),
    (f"{LOW} guide=-80 ppo=-90", "zero -", "1 everything else here but"),
    ("guide=50 ppo=40,30 zero=50.1,", "guide -", "3 zero"),
    (
        f"{WORSE} guide=-230 ppo=-300,0",
        "zero -",
        "1 (-200.0), which no guide and no trained policy",
    ),
    # Nothing is better than random actions.
    ("guide=-5 opposite=-6 ppo=-1,1 A=0.3,-4", "nothing A", "1 clearly better than random actions"),
    ("guide=-5 opposite=-6 failed=ppo", "nothing -", "1 no training finished"),
    ("guide=-5 opposite=-6 failed=ppo", "nothing -", "3 what made the trainings fail"),
]


@pytest.mark.parametrize(("means", "decided", "said"), RULES)
def test_rule_decides_what_is_used_and_trained_and_says_why(means, decided, said):
    given, failed = {}, []
    for name, text in (word.split("=") for word in means.split()):
        if name == "failed":
            failed = [NAMES.get(each, each) for each in text.split(",")]
        else:
            values = [float(each) for each in text.split(",") if each]
            given[NAMES.get(name, name)] = values if "," in text else values[0]
    found = verdict(entries(**given), failed=failed)
    assert [found.use, found.train] == [NAMES.get(each, each) for each in decided.split()]
    assert len(found.sentences) == 3
    assert found.wrong_way_round or "wrong way round" not in found.sentences[0]
    number, _, text = said.partition(" ")
    if number == "score":
        assert found.score == pytest.approx(float(text))
    else:
        shown = f"|{found.sentences[int(number) - 1]}|"
        assert (text.removeprefix("!") in shown) != text.startswith("!")


@pytest.mark.parametrize(("opposite", "is_reversed"), [(55.2, False), (56.2, True)])
def test_opposite_must_be_better_by_a_tenth_of_the_way_from_random_to_the_best(
    opposite, is_reversed
):
    found = verdict(entries(guide=50.0, opposite=opposite))
    assert (found.use == "opposite") == found.wrong_way_round == is_reversed


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
