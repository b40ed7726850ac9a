"""How many frames a comparison gives to each training, from measured times."""

import pytest
from omegaconf import OmegaConf

from coil_rl.comparison.arms import ANCHORED, ARMS, PPO, SAC, TESTED_CASES, job_of
from coil_rl.comparison.timing import LEAST_BATCHES, LEAST_FRAMES, Pace, plan, seconds_of
from coil_rl.config.python import Named

BATCH = 8 * 256
CONFIG = OmegaConf.create(
    {
        "budget": {"frames": 1_000_000, "num_envs": 8, "steps": 256},
        "evaluation": {"cases": 20, "curve": {"num_envs": 20, "count_key": "cases"}},
    }
)
REPLAY = OmegaConf.merge(CONFIG, {"budget": {"steps": 4}})
ARMS_HERE = [ARMS[PPO], ARMS[ANCHORED]]


def planned(minutes, guide=0.0, step=1e-4, config=CONFIG):
    return plan({PPO: config}, Pace(step, guide, {PPO: 2 * step}, 200, 1.0), ARMS_HERE, minutes)


def test_training_gets_a_tenth_of_the_budget_in_whole_batches_where_time_allows():
    found = planned(minutes=100)
    assert found.frames == dict.fromkeys((PPO, ANCHORED), round(100_000 / BATCH) * BATCH)
    assert (found.cases, found.seeds, found.jobs) == (20, 2, 4)


def test_training_gets_what_the_minutes_allow():
    found = planned(minutes=0.5)
    assert LEAST_BATCHES * BATCH < found.frames[PPO] < 100_000
    assert found.frames[PPO] % BATCH == 0
    assert found.seconds <= 30


def test_slow_guide_leaves_a_few_batches_and_fewer_cases_and_it_is_said():
    found = planned(minutes=2, guide=5e-3)
    assert found.frames[ANCHORED] == (LEAST_BATCHES + 2) * BATCH < found.frames[PPO]
    assert 2 * BATCH > 3 * TESTED_CASES * 200 > BATCH, "steps of the start test"
    assert found.cases == 5
    assert found.seconds > 120
    assert "minutes=2 is not enough" in found.described(2)
    assert "2 seeds" in found.described(2)


@pytest.mark.parametrize("frames", [100, 5000])
def test_training_is_never_longer_than_the_whole_budget(frames):
    config = OmegaConf.merge(CONFIG, {"budget": {"frames": frames}})
    assert max(planned(minutes=10, config=config).frames.values()) <= frames


def test_all_learners_get_the_same_time():
    pace = Pace(1e-4, 0.0, {PPO: 2e-4, SAC: 3e-3}, 200, 1.0)
    found = plan({PPO: CONFIG, SAC: REPLAY}, pace, [ARMS[PPO], ARMS[SAC]], minutes=2)
    seconds = [frames * pace.learning[name] for name, frames in found.frames.items()]
    assert seconds[0] == pytest.approx(100_352 * 2e-4)  # a tenth of the budget
    assert seconds[1] == pytest.approx((120 - found.seconds) / 2 + seconds[1], abs=0.1)
    assert found.frames[SAC] > LEAST_FRAMES


def test_learner_with_replay_has_enough_frames_to_learn_on_a_slow_env():
    pace = Pace(0.01, 0.0, {PPO: 0.01, SAC: 0.013}, 200, 1.0)
    found = plan({PPO: CONFIG, SAC: REPLAY}, pace, [ARMS[PPO], ARMS[SAC]], minutes=2)
    assert found.frames == {PPO: LEAST_BATCHES * BATCH, SAC: 2016}


def test_processor_counts_and_what_each_piece_waits():
    busy = [(0.010, 0.001), (0.0010, 0.001), (0.030, 0.004)]  # beside other programs
    assert seconds_of(busy) == (pytest.approx(0.002), 0)
    assert seconds_of([(0.006, 0.001), (0.020, 0.001)]) == pytest.approx((0.006, 0.005))


def test_least_cases_that_were_given_are_kept():
    word = "learner.anchor.least_cases=8"

    def least(arm, *given):
        words = job_of(Named(given, {}), ARMS[arm], 0, 100, []).words
        return [each for each in words if "least_cases" in each]

    assert least(ANCHORED, word) == [word]
    assert least(ANCHORED) == [f"learner.anchor.least_cases={TESTED_CASES}"]
    assert least(PPO) == []
