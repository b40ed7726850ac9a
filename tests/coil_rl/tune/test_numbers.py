"""The numbers of guides that `tune` names: which there are, and what is refused."""

from collections.abc import Sequence
from functools import partial

import programs
import pytest

from coil_rl.config.nodes import build, keep
from coil_rl.errors import UserError
from coil_rl.tune.numbers import (
    GuideWithNumbers,
    _number,
    numbers_of,
    numbers_to_tune,
    with_numbers,
)


class PID:
    """A controller with three gains and a horizon."""

    def __init__(self, kp=1.0, ki=0, kd=0.1, horizon: int = 5, name="mine", clip=True):
        self.kp, self.horizon = kp, horizon

    def act(self, observation):
        return [self.kp * float(observation[0])]


composed = partial(programs.composed, "method=tune", "run_dir=unused")
CONTROLLER = {
    "_target_": "coil_rl.guides.ControllerGuide",
    "of": f"{__name__}:PID",
    "in_keys": None,
    "options": {"kp": 2.0},
}


def test_numbers_of_a_controller_are_the_arguments_of_its_class():
    found = numbers_of(CONTROLLER, "guide.controller")
    assert found == {"kp": (2, False), "ki": (0, False), "kd": (0.1, False), "horizon": (5, True)}


def test_numbers_of_a_partial_of_a_class_are_those_that_it_gives():
    node = CONTROLLER | {"of": keep("test#guide", partial(PID, kp=3.0, kd=0.5)), "options": {}}
    found = numbers_of(node, "guide.controller")
    assert found == {"kp": (3, False), "ki": (0, False), "kd": (0.5, False), "horizon": (5, True)}
    tuned = build(with_numbers(node, "guide.controller", {"kp": 7.0}), "guide.controller")
    assert tuned.guide.make().kp == 7.0


def test_numbers_of_a_function_are_its_arguments_and_the_items_of_lists():
    node = composed("env=cart_pole").guide.linear_feedback
    weights = enumerate([0.1, 0.3, 1.0, 0.5])
    assert numbers_of(node, "guide") == {f"weights.{n}": (each, False) for n, each in weights}


class Whole:
    def __init__(
        self,
        window: int | None = 4,
        delay: "Optional[int]" = 2,  # noqa: F821  as with annotations that are not evaluated
        orders: list[int] = (1, 2),
        lags: Sequence[int] | None = (3,),
        gains: list[float] = (1, 2),
        either: int | float = 1,
        pair: tuple[int, float] = (1, 2.0),
    ):
        self.given = window, delay, orders, lags

    def act(self, observation):
        return [0.0]


def test_whole_numbers_are_those_annotated_as_such_also_in_lists_and_unions():
    node = CONTROLLER | {"of": f"{__name__}:Whole", "options": {}}
    whole = ("window", "delay", "orders.0", "orders.1", "lags.0")
    found = numbers_of(node, "guide.controller")
    assert {name for name, (_, is_whole) in found.items() if is_whole} == {*whole}
    assert found.keys() - whole == {"gains.0", "gains.1", "either", "pair.0", "pair.1"}
    values = {"window": 5.6, "delay": 1.4, "orders.1": 6.7, "lags.0": 2.2}
    tuned = build(with_numbers(node, "guide.controller", values), "guide.controller")
    window, delay, orders, lags = tuned.guide.make().given
    assert (window, delay, list(orders), list(lags)) == (6, 1, [1, 7], [2])


def test_node_gets_other_numbers_and_keeps_the_rest():
    changed = with_numbers(CONTROLLER, "guide.controller", {"ki": 0.5, "horizon": 3.0})
    assert changed["options"] == {"kp": 2.0, "ki": 0.5, "horizon": 3}
    assert CONTROLLER["options"] == {"kp": 2.0}


def test_guide_is_built_with_other_items_of_a_list():
    make = GuideWithNumbers(composed("env=cart_pole"))
    guide = make({"weights.2": -1.0})
    assert guide.function.keywords["weights"] == [0.1, 0.3, -1.0, 0.5]


def test_bounds_are_read_with_the_own_value():
    nested = composed("env=cart_pole", "tune={weights: {2: [0, 2]}}")
    assert [number.name for number in numbers_to_tune(nested)] == ["weights.2"]
    [kp] = numbers_to_tune(composed("env=pendulum", "tune={gain: [0.1, 10, log]}"))
    assert (kp.name, kp.low, kp.high, kp.own, kp.log) == ("gain", 0.1, 10.0, 5.0, True)
    assert kp.value(kp.place(2.5)) == pytest.approx(2.5)
    assert kp.value(0.5) == pytest.approx(1.0)


def test_bounds_of_a_whole_number_are_whole():
    number = _number("n", [2.6, 4.9], 3.0, True)
    assert {number.value(place / 10) for place in range(11)} == {3.0, 4.0}
    with pytest.raises(UserError, match="there are no two between these bounds"):
        _number("n", [3.55, 4.9], 3.0, True)


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        ("tune={gian: [0, 1]}", "tune.gian is no number of the guide; guide.swing_up has gain"),
        ("tune={gain: [2, 1]}", "lower bound must be below"),
        ("tune={gain: [1, 1]}", "lower bound must be below"),
        ("tune={gain: [0, 1, log]}", "must be above 0"),
        ("tune={gain: [-1, 1, log]}", "must be above 0"),
        ("tune={gain: [a, 1]}", "'a' is not a number"),
        ("tune={gain: [true, 2]}", "true is not a number"),
        ("tune={gain: [.nan, 2]}", "is not a number"),
        ("tune={gain: [0, .inf]}", "is not a number"),
        ("tune={gain: [1]}", r"must be \[low, high\]"),
        ("tune={gain: [1, 2, linear]}", r"or \[low, high, log\] to search"),
        ("tune={gain: 3}", r"must be \[low, high\]"),
        ("tune=gain", "must be the bounds by name"),
        ("tune={}", "needs the numbers to tune"),
        ("guide=zero tune={gain: [0, 1]}", "guide.zero has no numbers"),
        ("guide=none tune={gain: [0, 1]}", "tunes one guide, but there is none"),
        ("guide=[zero,swing_up] tune={gain: [0, 1]}", "but there is zero, swing_up"),
    ],
)
def test_mistake_is_one_sentence_that_says_what_exists(overrides, sentence):
    given = overrides.replace(" tune", "|tune").split("|")
    with pytest.raises(UserError, match=sentence):
        numbers_to_tune(composed("env=pendulum", *given))


@pytest.mark.parametrize(
    ("env", "values"),
    [("pendulum", {"gain": 7.123456789012345}), ("cart_pole", {"weights.1": -0.5, "weights.3": 1})],
)
def test_words_give_the_controller_itself_its_numbers(env, values):
    make = GuideWithNumbers(composed(f"env={env}"))
    config = composed(f"env={env}", *make.words(values))
    assert not any(word.startswith("++") for word in make.words(values))
    found = numbers_of(GuideWithNumbers(config).node, make.name)
    assert {name: found[name][0] for name in values} == values
