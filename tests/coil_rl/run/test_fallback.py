import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from coil_rl.report.statistics import mean_interval
from coil_rl.report.table import return_format
from coil_rl.run.evaluation import EvaluationResult
from coil_rl.run.fallback import Fallback
from coil_rl.run.judge import not_worse


def constant(number):
    return TensorDictModule(
        lambda x: torch.full_like(x, number), in_keys=["observation"], out_keys=["action"]
    )


def result_of(rewards, steps=1):
    return EvaluationResult([{"reward": reward, "steps": steps} for reward in rewards])


def test_guide_acts_from_a_low_value_on_until_a_high_one():
    critic = TensorDictModule(lambda x: x, in_keys=["observation"], out_keys=["state_value"])
    fallback = Fallback(constant(0.0), critic, constant(1.0), leave=2.0, back=5.0)
    values = torch.tensor([[3.0, 1, 4, 6, 3, 1], [6.0, 6, 2, 1.9, 2.1, 4.9]])
    actions = [
        fallback(TensorDict({"observation": column[:, None]}, [2]))["action"][:, 0]
        for column in values.T
    ]
    assert torch.stack(actions, 1).tolist() == [[0, 1, 1, 0, 0, 1], [0, 0, 0, 1, 1, 1]]
    assert fallback.share(result_of([0, 0], steps=6)) == pytest.approx(6 / 12)
    assert fallback.share(result_of([0, 0], steps=3)) == pytest.approx(2 / 6)


@pytest.mark.parametrize(
    ("agent", "answer"),
    [
        ([101, 102, 103], "yes"),
        ([99.5, 99.5, 99.5], "yes"),
        ([98.5, 98.5, 98.5], "no"),
        ([90, 91, 92], "no"),
        ([80, 120, 100], "undecided"),
    ],
)
@pytest.mark.parametrize("zero", [0, -100, -1_000_000])  # that of the rewards means nothing
def test_agent_is_not_worse_if_the_whole_interval_is_above_one_percent_less(agent, answer, zero):
    mine, guide = ([zero + reward for reward in each] for each in (agent, [100, 100, 100]))
    (sentence,) = not_worse(result_of(mine), result_of(guide), "guide", chance=zero)
    assert f"Not worse than guide on these 3 cases: {answer} " in sentence
    _, low, high = mean_interval([reward - 100 for reward in agent])
    spec = return_format([sum(mine) / 3, sum(guide) / 3])
    assert f"{low:+{spec}} to {high:+{spec}}" in sentence


def test_agent_with_the_returns_of_its_guide_has_no_interval():
    (sentence,) = not_worse(result_of([100, 90]), result_of([100, 90]), "guide", chance=0)
    assert sentence == (
        "Not worse than guide on these 2 cases: yes, the return is the same in each of them."
    )
