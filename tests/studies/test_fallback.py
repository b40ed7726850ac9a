import pytest
import torch
from tensordict import TensorDict
from worlds import acting

from coil_rl.run.evaluation import EvaluationResult
from coil_studies.fallback import FallbackPolicy


def constant(number):
    return acting(lambda x: torch.full_like(x, number), "observation")


def result_of(rewards, steps=1):
    return EvaluationResult([{"reward": reward, "steps": steps} for reward in rewards])


def test_guide_acts_from_a_low_value_on_until_a_high_one():
    critic = acting(lambda x: x, "observation", out="state_value")
    fallback = FallbackPolicy(constant(0.0), critic, constant(1.0), leave=2.0, back=5.0)
    values = torch.tensor([[3.0, 1, 4, 6, 3, 1], [6.0, 6, 2, 1.9, 2.1, 4.9]])
    actions = [
        fallback(TensorDict({"observation": column[:, None]}, [2]))["action"][:, 0]
        for column in values.T
    ]
    assert torch.stack(actions, 1).tolist() == [[0, 1, 1, 0, 0, 1], [0, 0, 0, 1, 1, 1]]
    assert fallback.share(result_of([0, 0], steps=6)) == pytest.approx(6 / 12)
    assert fallback.share(result_of([0, 0], steps=3)) == pytest.approx(2 / 6)
