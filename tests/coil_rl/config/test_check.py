"""A method is refused where it cannot learn, and so is a word that nothing reads."""

import odd_parts
import pytest
import torch
from programs import SHORT_LAP, called, composed, shipped

import coil_rl
from coil_rl.config.check import check, check_read
from coil_rl.config.compose import compose_train
from coil_rl.config.parts import env_maker
from coil_rl.errors import UserError

METHODS = shipped("method")
# Methods that take choices as actions; all others need numbers.
WITH_CHOICES = (
    *("coil_anchored", "coil", "coil_dropout", "rfc", "coil_rfc", "kickstart", "jump_start"),
    *("imitate_then_ppo", "advisor", "dagger", "oil", "ppo"),
)
# They have no agent, or need several guides, or numbers of a guide.
OTHERS = ("guide", "coil_multi", "tune")


SMALL = ["evaluation.cases=2", "evaluation.curve.num_envs=2", "logger=none"]


def check_switches(method, folder):
    """Check a run of a method in an env whose actions are several switches."""
    env = ["env=gym", "env.id=odd_parts:Acts", "+env.options.space=switches", *SMALL]
    guide = ["guide=controller", "guide.controller.of=odd_parts:on"]
    check(composed(*env, *guide, f"method={method}", f"run_dir={folder}"))


@pytest.mark.fast(2)
@pytest.mark.parametrize("method", sorted({*METHODS} - {*OTHERS}))
def test_method_takes_choices_or_is_refused_with_those_that_do(method, tmp_path):
    if method in WITH_CHOICES:
        check_switches(method, tmp_path)
        return
    message = r" needs continuous actions, but this env .* method=coil_anchored"
    with pytest.raises(UserError, match=message):
        check_switches(method, tmp_path)


def unread(*words):
    """Return the reason why the last of some words is not read; empty if it is."""
    try:
        check_read(compose_train(list(words)), words[-1:])
    except UserError as error:
        return str(error)
    return ""


@pytest.mark.fast(6)
@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("method=dagger budget.minibatches=3", "nothing in this run reads budget.minibatches"),
        ("learner=sac training.learning_rate=1", "(method=coil); leave it out"),
        ("training.imitation_env.assignment=random", "reads training.imitation_env.assignment"),
        ("training.tests.starts=5", "reads training.tests.starts (method=coil)"),
        ("recording=drive.mcap", "nothing in this run reads recording (method=coil)"),
        ("method.needs_guide=false", "nothing in this run reads method.needs_guide (method=coil)"),
        ("method=guide learner.gamma=0.9", "(method=guide); leave it out"),
        ("method=guide training.noise_correlation=0.5", "(method=guide)"),
        ("method=guide budget.num_envs=3", "(method=guide)"),
        ("method=guide evaluation.curve.points=2", "(method=guide)"),
        ("method=guide logger=csv", "(method=guide)"),
        ("method=tune learner.gamma=0.9", "(method=tune)"),
        ("method=tune network=mlp", "(method=tune)"),
        ("method=tune checkpoint_every=3", "(method=tune)"),
        ("action=choices training.noise_correlation=0.5", "noise_correlation (method=coil)"),
        ("method=oil training.noise_correlation=0.5", "noise_correlation (method=oil)"),
        ("method=ppo +degrade@evaluation.advice.a=zeroed", "evaluation.advice.a (method=ppo)"),
        (
            "method=dynamic_coil_sequential +degrade@evaluation.advice.a=zeroed",
            "evaluation.advice.a (method=dynamic_coil_sequential)",
        ),
        ("method=coil_anchored training.tests.starts=5", ""),  # where policies are compared
        ("delivery=tested training.tests.starts=5", ""),
        ("method=tune budget.frames=1000", ""),
        ("method=tune training.tests.starts=5", ""),
        ("method=tune evaluation.curve.points=2", ""),
        ("method=guide env.rate=10", ""),
        ("method=guide preset.rate=10", ""),
        ("method=guide track=generated track.test.count=2", ""),
        ("method=guide evaluation.gif=false", ""),
        ("method=guide seed=3", ""),
        ("method=guide degrade=[noisy]", ""),
        ("method=guide env.time_limit=${budget.steps} budget.steps=3", ""),  # the env refers to it
        ("method=coil training.noise_correlation=0.5", ""),
    ],
)
def test_word_is_refused_where_nothing_reads_it(words, message):
    said = unread(*words.split())
    assert message in said
    assert bool(message) == bool(said)


@pytest.mark.slow
def test_each_run_of_a_sweep_says_what_it_does_not_read(tmp_path):
    words = ["-m", "method=guide", "seed=0,1", *SHORT_LAP, "evaluation.gif=false"]
    said = called("train", *words, "learner.gamma=0.9", cwd=tmp_path).stderr
    assert said.count("learner.gamma=0.9 has no effect: nothing in this run reads") == 2


@pytest.mark.slow
def test_words_from_python_are_read_too(tmp_path):
    words = ["logger=none", "proxy.seed=3"]
    folder = tmp_path / "run"
    with pytest.raises(UserError, match=r"proxy\.seed=3 has no effect"):
        coil_rl.prepare("cone_track", method="ppo", folder=folder, overrides=words)
    with pytest.raises(UserError, match=r"budget\.frames=64 has no effect"):
        coil_rl.prepare("cone_track", guide="spline", method="guide", frames=64, folder=folder)
    assert not folder.exists()


@pytest.mark.parametrize(
    ("space", "of", "given"),
    [
        ("wide", "far", 1000.0),  # clamped to the upper bound
        ("unit", "seven", 1.0),
        ("scalar", "seven", 7.0),
        ("half", "far", 5e6),  # no upper bound
        ("half_floats", "far", 1.0),
        ("from5", "seven", 7),
        ("from5", "six", 6),
    ],
)
def test_env_is_given_the_action_of_its_guide_in_its_own_numbers(space, of, given, monkeypatch):
    monkeypatch.setattr(odd_parts.Acts, "taken", [])
    words = ["env=gym", "env.id=odd_parts:Acts", f"+env.options.space={space}", *SMALL]
    words += ["guide=controller", f"guide.controller.of=odd_parts:{of}", "method=guide"]
    env, policy = env_maker(compose_train([*words, "run_dir=run"])).guided(1, "test")
    with torch.no_grad():
        env.rollout(3, policy)
    assert odd_parts.Acts.taken == [given] * 3
