import pytest
from omegaconf import DictConfig

from coil_rl import UserError
from coil_rl.config.compose import compose_train
from coil_rl.config.values import complete_measures

ADDED = "evaluation.measures.last_reward."
WORDS = ["env=pendulum", "method=ppo"]


def measures_with(*words: str) -> DictConfig:
    config = compose_train([*WORDS, *words])
    complete_measures(config)
    return config.evaluation.measures


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
    assert measures.last_reward.reduction == "last"
    assert measures.last_reward.format == "auto"


@pytest.mark.parametrize("name", ["reward", "case", "driver", "steps"])
def test_a_measure_named_as_another_column_is_refused(name: str) -> None:
    with pytest.raises(UserError, match=f"{name} is already a column of the tables"):
        measures_with(f"evaluation.measures.{name}.entry=reward")


def test_values_of_a_measure_have_their_types() -> None:
    with pytest.raises(UserError, match=r"measures\.low: at_least: Value 'much'"):
        measures_with("evaluation.measures.low={entry: reward, at_least: much}")
