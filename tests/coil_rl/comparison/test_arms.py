"""The arms of a comparison: the words of their trainings."""

import inspect

import pytest

from coil_rl.comparison.arms import ARMS, PPO, job_of
from coil_rl.config.python import Named
from coil_rl.learners.off_policy import OffPolicy


@pytest.mark.parametrize(("frames", "starts"), [(8_192, 4_096), (400_000, None)])
def test_sac_learns_from_half_of_few_frames_and_else_as_usual(frames, starts):
    usual = inspect.signature(OffPolicy).parameters["starts"].default
    words = job_of(Named(["env=pendulum"], {}), ARMS["sac"], 0, frames, []).words
    assert f"learner.starts={starts or usual}" in words
    given = Named(["env=pendulum", "learner.starts=7"], {})
    assert "learner.starts=7" in job_of(given, ARMS["sac"], 0, frames, []).words
    ppo = job_of(Named(["env=pendulum"], {}), ARMS[PPO], 0, frames, []).words
    assert not any(word.startswith("learner.starts") for word in ppo)
