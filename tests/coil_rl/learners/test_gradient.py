import copy
import warnings
from functools import partial

import pytest
import torch
import worlds

from coil_rl.errors import UserError
from coil_rl.learners import A2C, DQN, PPO, SAC, TQC, CrossQ, gradient
from coil_rl.learners.gradient import GradientStep
from coil_rl.run.rollout import Rollout
from coil_rl.transforms import DiscreteActions


def make(learner, compile, *transforms, **options):
    torch.manual_seed(0)
    env = worlds.cones(*(transform() for transform in transforms))
    made = learner(env, ["observation", "guide_action"], hidden=[8], compile=compile, **options)
    return made, Rollout(env, made.policy, 16, made.keys)


def numbers(learner):
    return torch.cat([parameter.detach().flatten() for parameter in learner.gradient.parameters])


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    one_for_all_tests = str(tmp_path_factory.getbasetemp())
    monkeypatch.setenv("XDG_CACHE_HOME", one_for_all_tests)


REPLAY = {"starts": 64, "batch_size": 32}
CASES = {
    "ppo": (PPO, (), {"minibatches": 4}),
    "a2c": (A2C, (), {"minibatches": 4}),
    "clipped": (PPO, (), {"minibatches": 4, "normalise": True, "squash": False}),
    "sac": (SAC, (), REPLAY),
    "redq": (SAC, (), REPLAY | {"critics": 3, "target_critics": 2}),
    # Biases before a normalisation have gradients of rounding alone, which Adam makes steps of.
    "crossq": (CrossQ, (), REPLAY | {"learning_rate": 1e-6}),
    "tqc": (TQC, (), REPLAY | {"quantiles": 5, "n_step": 3}),
    "dqn": (DQN, (partial(DiscreteActions, 5),), REPLAY),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_compiled_update_is_the_update_and_continues_to_the_bit(case):
    learner, transforms, options = CASES[case]
    one, rollout = make(learner, False, *transforms, **options)
    other, third = (make(learner, "auto", *transforms, **options)[0] for _ in range(2))
    batches = [rollout.collect() for _ in range(3)]
    for count, batch in enumerate(batches):
        states = []
        for each in (one, other, third):
            torch.manual_seed(count)
            states.append(each.update(batch.clone(), count / 3))
        expected, found, _ = states
        assert (found.pop("compiled"), expected.pop("compiled")) == (float(count > 0), 0.0)
        for each in (other, third):
            each.gradient.compile = True
        assert list(found) == list(expected)
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)
        third.load_state_dict(copy.deepcopy(third.state_dict()))
        if count == 1:
            fresh, _ = make(learner, True, *transforms, **options)
            fresh.load_state_dict(copy.deepcopy(third.state_dict()))
            third = fresh
    torch.testing.assert_close(numbers(one), numbers(other), rtol=1e-3, atol=1e-4)
    assert torch.equal(numbers(other), numbers(third))


def test_auto_compiles_a_run_of_many_steps_and_remembers_it(monkeypatch):
    monkeypatch.setattr(gradient, "ENOUGH", 100)
    for updates, expected in ((2, False), (10, True)):  # of 20 steps each
        ppo, rollout = make(PPO, "auto", minibatches=4)
        for waiting in (0.0, 0.2):  # with replay nothing is learned at first
            ppo.gradient.begin(waiting)
        ppo.update(rollout.collect(), 0.4)
        assert ppo.gradient.compile == "auto"
        ppo.gradient.begin(0.4 + 0.6 / updates)
        assert ppo.gradient.compile is expected
        assert ppo.state_dict()["gradient"]["compile"] is expected


@pytest.mark.slow
def test_auto_goes_on_without_a_compiler_and_true_does_not(monkeypatch, tmp_path):
    monkeypatch.setenv("CXX", "missing")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(gradient, "ENOUGH", 1)
    ppo, rollout = make(PPO, "auto", minibatches=3)
    ppo.update(rollout.collect(), 0.0)
    with pytest.warns(UserWarning, match=r"without a C\+\+ compiler.*goes on uncompiled"):
        assert ppo.update(rollout.collect(), 0.5)["compiled"] == 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ppo.update(rollout.collect(), 0.75)
    required, _ = make(PPO, True, minibatches=3)
    with pytest.raises(UserError, match="install one, or take compile=false"):
        required.update(rollout.collect())


def test_update_on_a_gpu_is_not_compiled():
    # No memory is behind this device, and no GPU is needed for it.
    weight = torch.nn.Parameter(torch.ones(1, device="meta"))
    with pytest.raises(ValueError, match="compile=true: code is compiled for the CPU only"):
        GradientStep(
            lambda _: {"loss": weight.sum()},
            [[weight]],
            [],
            lambda _: [1e-3],
            eps=1e-5,
            max_grad_norm=1.0,
            compile=True,
        )
