import pytest
import torch
from tensordict import TensorDict

from coil_rl.errors import UserError
from coil_rl.train.finite import check_batch, check_losses, check_state


def batch():
    after = {"observation": torch.zeros(4, 6, 3), "info": {"pose": torch.zeros(4, 6, 2)}}
    count = torch.zeros(4, 6, 1, dtype=torch.int64)
    return TensorDict({"observation": torch.zeros(4, 6, 3), "count": count, "next": after}, [4, 6])


def test_finite_batch_passes():
    check_batch(batch())
    check_batch(TensorDict({"none": torch.zeros(4, 6, 0), "done": torch.zeros(4, 6, 1, dtype=torch.bool)}, [4, 6]))


@pytest.mark.parametrize(
    ("where", "words"),
    [
        ([("observation", 3, 2, 1)], "observation is nan at step 103 of car 3"),
        (
            [("observation", 1, 3, 1), (("next", "observation"), 1, 2, 1)],
            "next/observation is nan at step 103 of car 1",
        ),
        ([(("next", "info", "pose"), 2, 5, 0), ("observation", 2, 5, 0)], "observation is nan at step 106 of car 2"),
        ([(("next", "info", "pose"), 0, 1, 0), ("observation", 3, 4, 0)], "next/info/pose is nan at step 102 of car 0"),
    ],
)
def test_first_entry_that_is_nan_is_named_with_its_step_and_car(where, words):
    bad = batch()
    for key, car, t, number in where:
        bad[key][car, t, number] = torch.nan
    with pytest.raises(UserError, match=f"^{words}$"):
        check_batch(bad, steps=100)


def test_infinity_and_an_env_without_a_batch_dimension():
    bad = batch()[0]
    bad["next", "observation"][4, 0] = -torch.inf
    with pytest.raises(UserError, match="next/observation is -inf at step 5 of car 0"):
        check_batch(bad)


def test_a_loss_and_a_weight_that_are_nan_are_named():
    check_losses({"learner/loss": 1.0}, 7)
    with pytest.raises(UserError, match="learner/loss is nan in update 7"):
        check_losses({"learner/rate": 1.0, "learner/loss": float("nan")}, 7)
    state = {"policy": {"bias": torch.tensor([0, torch.nan])}, "bound": torch.tensor(-torch.inf), "order": [1]}
    with pytest.raises(UserError, match="learner/policy/bias is nan after update 7"):
        check_state(state, 7)
    check_state({"bound": state["bound"]}, 7)
