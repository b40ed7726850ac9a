import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, GymEnv, PendulumEnv, SerialEnv, TransformedEnv

from coil_rl.envs import ConeTrackEnv, random_tracks
from coil_rl.testing import check_env
from coil_rl.transforms import DelayedAdvice, GuideActions, RemovedAdvice, ScaledAdvice, ShuffledAdvice

CARS = 5
WORLD = ConeTrackEnv(random_tracks(count=1, seed=5), CARS)


class Counting(TensorDictModule):
    """Says something different at every call and to every row: 0.01 * calls + 0.1 * row."""

    def __init__(self):
        super().__init__(self.say, in_keys=["steering"], out_keys=["action"])
        self.calls = -1

    def say(self, steering):
        self.calls += 1
        return (0.01 * self.calls + 0.1 * torch.arange(len(steering))).unsqueeze(-1)


def counting_env(*degraders):
    return TransformedEnv(WORLD, Compose(GuideActions({"counting": Counting()}), *degraders))


def advice(data):
    """In hundredths, [CARS, ...]: tens are the row that it was meant for, ones the call."""
    return (data["guide_action"] * 100).round().int().squeeze(-1).squeeze(-1)


def still(td):
    return td.set("action", torch.zeros(CARS, 1))


def reset_rows(env, data, *rows):
    mask = torch.zeros(CARS, 1, dtype=torch.bool)
    mask[list(rows)] = True
    return env.reset(data.clone().set("_reset", mask))


def test_advice_is_delayed_by_k_steps_and_the_first_one_until_then():
    rollout = counting_env(DelayedAdvice(3)).rollout(8, still)
    assert advice(rollout)[0].tolist() == [0, 0, 0, 0, 1, 2, 3, 4]
    assert advice(rollout)[4].tolist() == [40, 40, 40, 40, 41, 42, 43, 44]


def test_delay_of_a_row_begins_anew_with_its_episode():
    env = counting_env(DelayedAdvice(2))
    carrier = env.reset()
    for _ in range(4):
        carrier = env.step(still(carrier))["next"]
    assert advice(carrier).tolist() == [2, 12, 22, 32, 42]
    # The guide is asked about the row that begins alone, so it takes it for the first one.
    carrier = reset_rows(env, carrier, 1)
    assert advice(carrier).tolist() == [2, 5, 22, 32, 42]
    seen = []
    for _ in range(3):
        carrier = env.step(still(carrier))["next"]
        seen.append(advice(carrier).tolist())
    assert seen == [[3, 5, 23, 33, 43], [4, 5, 24, 34, 44], [6, 16, 26, 36, 46]]


def test_what_is_to_be_given_later_travels_with_the_data():
    env = counting_env(DelayedAdvice(2))
    carrier = env.reset()
    for _ in range(3):
        carrier = env.step(still(carrier))["next"]
    kept, other = carrier.clone(), counting_env(DelayedAdvice(2))
    other.load_state_dict(env.state_dict())
    assert torch.equal(advice(other.step(still(kept))["next"]), advice(env.step(still(carrier))["next"]))


def test_a_delay_of_zero_steps_changes_nothing():
    env = counting_env(DelayedAdvice(0))
    assert "delayed_advice" not in env.observation_spec
    assert torch.equal(advice(env.rollout(4, still)), advice(counting_env().rollout(4, still)))


def test_two_delays_add_up_under_keys_of_their_own():
    env = counting_env(DelayedAdvice(1), DelayedAdvice(2, memory_key="delayed_again"))
    check_env(env)
    assert torch.equal(
        advice(counting_env(DelayedAdvice(1), DelayedAdvice(2, memory_key="delayed_again")).rollout(8, still)),
        advice(counting_env(DelayedAdvice(3)).rollout(8, still)),
    )


def test_shuffled_advice_is_the_same_advice_in_other_rows_and_never_ones_own():
    rollout = counting_env(ShuffledAdvice(seed=1)).rollout(40, still, break_when_any_done=False)
    given, meant = advice(rollout), advice(counting_env().rollout(40, still, break_when_any_done=False))
    assert torch.equal(given.sort(0).values, meant.sort(0).values)
    assert (given != meant).all()
    assert len({tuple(column) for column in ((given - torch.arange(40)) // 10).t().tolist()}) == CARS - 1, (
        "all shifts should be drawn"
    )


def test_a_row_that_begins_is_given_what_was_meant_for_another_row_a_step_ago():
    for seed in range(10):
        # What follows must not be halved twice, nor what the guide says to the rows that do not begin be used.
        env = counting_env(ShuffledAdvice(seed), ScaledAdvice(0.5))
        carrier = env.step(still(env.reset()))["next"]
        after = reset_rows(env, carrier, 1, 3)
        given = (after["guide_action"] * 200).round().int().flatten()
        assert torch.equal(given[[0, 2, 4]], (carrier["guide_action"] * 200).round().int().flatten()[[0, 2, 4]])
        assert given[1] in (1, 21, 31, 41)
        assert given[3] in (1, 11, 21, 41)


def test_rows_that_all_begin_are_shuffled_among_themselves():
    env = counting_env(ShuffledAdvice())
    carrier = env.step(still(env.reset()))["next"]
    assert sorted(advice(reset_rows(env, carrier, *range(CARS))).tolist()) == [2, 12, 22, 32, 42]


def test_stored_rows_are_shuffled_whole():
    stored = TensorDict({"guide_action": torch.arange(24.0).view(2, 3, 2, 2)}, [2, 3])
    given = ShuffledAdvice()(stored.clone())["guide_action"]
    before, after = ([row.flatten().tolist() for row in x.flatten(0, 1)] for x in (stored["guide_action"], given))
    assert sorted(before) == sorted(after)
    assert all(one != other for one, other in zip(before, after, strict=True))


def test_one_row_alone_cannot_be_shuffled():
    for env in (SerialEnv(1, PendulumEnv), PendulumEnv()):
        guide = TensorDictModule(lambda speed: -speed.unsqueeze(-1), in_keys=["thdot"], out_keys=["action"])
        alone = TransformedEnv(env, GuideActions({"damp": guide}))
        with pytest.raises(ValueError, match="advice of another row, but the batch is one row"):
            alone.append_transform(ShuffledAdvice()).reset()


def test_removed_advice_is_the_last_action_and_nothing_at_the_start():
    env = counting_env(RemovedAdvice())
    carrier = env.reset()
    assert advice(carrier).eq(0).all()
    carrier = env.step(carrier.set("action", torch.full((CARS, 1), 0.25)))["next"]
    assert carrier["guide_action"].eq(0.25).all()
    assert advice(reset_rows(env, carrier, 2)).tolist() == [25, 25, 0, 25, 25]


@pytest.mark.parametrize("categorical", [True, False])
def test_a_choice_taken_last_is_one_hot_for_every_guide(categorical):
    def choose(observation):
        choice = torch.ones(observation.shape[:-1], dtype=torch.long)
        return choice if categorical else torch.nn.functional.one_hot(choice, 2)

    guides = {name: TensorDictModule(choose, in_keys=["observation"], out_keys=["action"]) for name in "ab"}
    env = GymEnv("CartPole-v1", categorical_action_encoding=categorical)
    env = TransformedEnv(env, GuideActions(guides)).append_transform(RemovedAdvice())
    start = env.reset()
    assert start["guide_action"].tolist() == [[0, 0], [0, 0]]
    start["action"] = torch.tensor(0) if categorical else torch.tensor([1, 0])
    assert env.step(start)["next", "guide_action"].tolist() == [[1, 0], [1, 0]]


@pytest.mark.parametrize("make", [DelayedAdvice, RemovedAdvice])
def test_one_moment_alone_is_refused_where_the_step_before_is_needed(make):
    with pytest.raises(RuntimeError, match=f"{make.__name__} needs the step"):
        make()(TensorDict({"guide_action": torch.zeros(3, 1, 1)}, [3]))
