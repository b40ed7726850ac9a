import pytest

from coil_rl import Measure, UserError
from coil_rl.config.compose import compose_train
from coil_rl.measures import measures_of

ADDED = "evaluation.measures.last_reward."
WORDS = ["env=pendulum", "method=ppo"]


def measures_with(*words: str) -> dict[str, Measure]:
    return measures_of(compose_train([*WORDS, *words]).evaluation.measures)


@pytest.mark.parametrize(
    "added",
    [
        [f"{ADDED}entry=reward", f"{ADDED}reduction=last"],
        [f"+{ADDED}entry=reward", f"+{ADDED}reduction=last"],
        ["evaluation.measures.last_reward={entry: reward, reduction: last}"],
    ],
)
def test_a_measure_is_added_on_the_command_line_beside_those_of_the_env(added: list[str]) -> None:
    measures = measures_with(*added)
    assert set(measures) == {"completed", "last_reward"}
    assert measures["last_reward"] == Measure("reward", "last")


@pytest.mark.parametrize("name", ["reward", "case", "driver", "steps"])
def test_a_measure_named_as_another_column_is_refused(name: str) -> None:
    with pytest.raises(UserError, match=f"{name} is already a column of the tables"):
        measures_with(f"evaluation.measures.{name}.entry=reward")


def test_values_of_a_measure_have_their_types() -> None:
    with pytest.raises(UserError, match=r"measures\.low: could not convert .* 'much'"):
        measures_with("evaluation.measures.low={entry: reward, at_least: much}")
