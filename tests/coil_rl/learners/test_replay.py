import copy

import pytest
import torch
import worlds
from tensordict import TensorDict
from torchrl.envs import PendulumEnv

from coil_rl.learners import Replay
from coil_rl.schedules import Linear
from coil_rl.transforms import MixedAction, ResidualAction, RewardCoupling, Takeover


def steps(first, count, **more):
    """Steps whose every entry is their number."""
    number = torch.arange(first, first + count).float().unsqueeze(-1)
    flag = torch.zeros_like(number, dtype=torch.bool)
    after = {"th": number.squeeze(-1), "reward": number, "done": flag, "terminated": flag}
    return TensorDict({"th": number.squeeze(-1), "action": number, "next": after, **more}, [count])


def replay(**options):
    return Replay(PendulumEnv(), ["th"], **{"capacity": 10, "batch_size": 4, "ratio": 1.0, "starts": 0} | options)


def kept(buffer):
    return sorted(buffer.buffer[:]["action"].flatten().tolist())


def test_the_newest_steps_take_the_place_of_the_oldest():
    buffer = replay()
    for first in (0, 6, 12):
        buffer.add(steps(first, 6))
    assert kept(buffer) == list(range(8, 18))


def test_a_step_is_drawn_as_often_as_the_ratio_says():
    buffer = replay(capacity=10_000, batch_size=50, ratio=2.5)
    drawn = torch.zeros(1_000)
    for first in range(0, 1_000, 30):
        buffer.add(steps(first, min(30, 1_000 - first)))
        for minibatch in buffer.draws():
            assert minibatch["action"].flatten().max() < first + 30
            assert torch.equal(minibatch["next", "reward"], minibatch["action"])
            drawn += torch.bincount(minibatch["action"].flatten().long(), minlength=1_000)
    assert drawn.sum() == 2.5 * 1_000


def test_nothing_is_drawn_before_it_starts():
    buffer = replay(starts=8)
    counts = []
    for first in (0, 4, 8):
        buffer.add(steps(first, 4))
        counts.append(len(list(buffer.draws())))
    assert counts == [0, 2, 1]


def test_steps_in_which_the_guide_acted_are_left_out():
    buffer = Replay(worlds.pendulum(Takeover(0.5)), ["th"], capacity=10, starts=0)
    assert "agent_acts" in buffer.keys
    buffer.add(steps(0, 6, agent_acts=torch.tensor([1, 0, 0, 1, 1, 0], dtype=torch.bool).unsqueeze(-1)))
    assert kept(buffer) == [0, 3, 4]
    buffer.add(steps(6, 2, agent_acts=torch.zeros(2, 1, dtype=torch.bool)))
    assert len(buffer) == 3


@pytest.mark.parametrize("count", [0, 4, 13])
def test_the_state_is_the_kept_steps_and_what_will_be_drawn(count):
    first, second = replay(), replay(seed=5)
    for number in range(count):
        first.add(steps(number, 1))
    list(first.draws())
    state = copy.deepcopy(first.state_dict())
    if count:
        assert len(state["steps"]["action"].untyped_storage()) == 4 * min(count, 10)
    second.add(steps(100, 7))
    second.load_state_dict(state)
    for buffer in (first, second):
        buffer.add(steps(50, 9))
    assert torch.equal(first.buffer[:]["action"], second.buffer[:]["action"])
    for one, other in zip(first.draws(), second.draws(), strict=True):
        assert (one == other).all()


@pytest.mark.parametrize(
    ("transform", "words"),
    [
        (ResidualAction(Linear(0, 1)), "scale of ResidualAction changes over the run"),
        (MixedAction(Linear(0, 1)), "weight of MixedAction changes over the run"),
        (RewardCoupling(Linear(1, 0)), "beta of RewardCoupling changes over the run"),
    ],
)
def test_what_an_action_leads_to_must_not_change_over_the_run(transform, words):
    with pytest.raises(ValueError, match=f"{words}.* or take a learner without replay, such as PPO"):
        Replay(worlds.pendulum(transform), ["th"])


def test_who_acts_may_change_over_the_run():
    Replay(worlds.pendulum(ResidualAction(0.5), Takeover(Linear(1, 0))), ["th"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"batch_size": 0}, "batch_size=0 must be at least 1"),
        ({"capacity": 0}, "capacity=0 must be at least 1"),
        ({"capacity": 10, "starts": 11}, "capacity=10 must be at least 1 and at least starts=11"),
        ({"ratio": -1}, "ratio=-1 must be at least 0"),
        ({"starts": -1}, "starts=-1 must be at least 0"),
        ({"seed": -1}, "seed=-1 must be at least 0"),
    ],
)
def test_numbers_out_of_range_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        replay(**options)
