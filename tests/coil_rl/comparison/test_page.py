"""The page of a comparison: its sentences, and the command to go on with."""

import shlex

import numpy as np
import pytest

from coil_rl.comparison.entry import Entry
from coil_rl.comparison.page import command_of, delayed_sentence, lowest_shown
from coil_rl.comparison.verdict import Verdict
from coil_rl.config.compose import compose_train
from coil_rl.config.python import Named


def entry(mean):
    return Entry("guide", mean + np.linspace(-1, 1, 5)[None])


def test_delay_says_what_is_kept_of_the_distance_from_random_actions():
    (said,) = delayed_sentence(entry(100.0), entry(75.0), entry(0.0))
    assert said.endswith("it keeps 75% of its distance from random actions.")


@pytest.mark.parametrize("own", [-382.0, -200.0])
def test_delay_says_nothing_of_a_distance_that_there_is_not(own):
    (said,) = delayed_sentence(entry(own), entry(-400.0), entry(-200.0))
    assert "keeps" not in said
    assert said.endswith(").")


@pytest.mark.parametrize(
    "word",
    [
        f"+env.options.mode={value}"
        for value in ("'null'", "'3'", "'1e3'", "'true'", "'inf'", "'a'", "'a b'", "'a:b'", "null")
    ],
)
def test_printed_command_has_the_values_of_the_comparison(word):
    words = ["env=gym", "env.id=Pendulum-v1", word]
    command = command_of(Named(words, {}), Verdict("ppo", "ppo", 1.0, 1.0, False))
    program, *printed = shlex.split(command)
    assert (program, printed[1]) == ("coil-train", "env.id=Pendulum-v1")
    place = ["method=ppo", "run_dir=unused"]
    expected = compose_train([*words, *place]).env.options.mode
    found = compose_train([*printed, "run_dir=unused"]).env.options.mode
    assert (type(found), found) == (type(expected), expected)


def test_picture_is_about_the_guide_and_what_is_better():
    means = {"random": -173.0, "guide": 24.6, "ppo": -170.0}
    entries = {name: Entry(name, np.full((1, 2), mean)) for name, mean in means.items()}
    assert lowest_shown(entries) == pytest.approx(24.6 - 19.76)
    entries["tune"] = Entry("tune", np.full((1, 2), 64.6))
    assert lowest_shown(entries) == pytest.approx(24.6 - 40)
    entries["guide"] = entries["random"]
    assert lowest_shown(entries) is None


@pytest.mark.parametrize(("tune", "written"), [("auto", "auto"), ({"kp": [1, 2]}, "{kp: [1, 2]}")])
def test_command_of_a_tuning_has_its_bounds(tune, written):
    given = Named(["env=pendulum", "guide=pid"], {"tune": tune})
    best = Verdict("tune", "tune", 1, 1, False)
    assert shlex.split(command_of(given, best))[-2:] == [f"tune={written}", "method=tune"]
    of_object = Named(given.words, given.nodes | {"guide.controller.of": None})
    assert f"tune={tune!r}" in command_of(of_object, best)
