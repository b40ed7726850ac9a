"""Odd words of a command line end in one sentence, or in the right number."""

import logging
import warnings

import numpy as np
import odd_parts
import pytest
import torch
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from coil_rl.config.check import check
from coil_rl.config.compose import compose_train
from coil_rl.config.messages import is_no_bug, sentence
from coil_rl.config.parts import env_maker
from coil_rl.config.unread import check_read

SMALL = ["evaluation.cases=2", "evaluation.curve.num_envs=2", "logger=none"]
NAMES = [  # guide.controller.of
    ("odd_parts", "of=odd_parts must be MODULE:NAME"),
    ("odd_parts.first", "of=odd_parts.first must be MODULE:NAME"),
    ("", "of= must be MODULE:NAME"),
    ("3", "of=3 is int; name a class, a function"),
    ("odd_parts:firts", "odd_parts has no firts; did you mean first?"),
    ("odd_party:first", "there is no module odd_party; install its package"),
]
WORDS = [  # of a run of PPO in env=gym env.id=odd_parts:Plain
    ("env.id=odd_parts:Nothing", "odd_parts has no env Nothing, and registers none of this name"),
    ("env.id=", "env.id is empty; write env.id=MODULE:NAME"),
    ("env.id=no_such-v3", "or PACKAGE:no_such-v3 if a package registers"),
    ("env.id=7", "env.id=7 must be a valid string or callable"),
    ("+env.options.speed=3", "it raised TypeError: Plain() takes no arguments"),
    ("env.max_steps=-5", "max_steps=-5 must be at least 1"),
    ("env.info=speed", "env.info='speed' must be a list"),
    ("observes=observation", "observes=observation must be a list; write observes=[observation]"),
    ("observes=[speed]", "the env has no entry speed to observe; it has observation"),
    ("budget.frames=1.5", "Value '1.5' of type 'float' could not be converted to Integer"),
    ("budget.frames=many", "Value 'many' of type 'str' could not be converted to Integer"),
    ("budget.steps=100000000", "budget.steps=100000000 must be at most 65536"),
    ("training.noise_correlation=much", "'much' of type 'str' could not be converted to Float"),
    ("compile=maybe", "Value 'maybe' is not a valid bool"),
    ("label=a/b", "label=a/b cannot be used: it must not be empty"),
    ("evaluation.cases=two", "evaluation.cases=two must be at least 1, or the names of the"),
    ("learner.hidden=64", "learner.hidden=64 must be a list"),
    ("learner=[ppo,sac]", "chooses several files of a group that takes one; for a run with each"),
    ("method=[ppo,coil]", "write -m method=ppo,coil"),
    ("degrade=[noisy]", "degrade=[noisy] has no effect, because there is no guide"),
    ("network=gru learner=sac", "SAC cannot train a network with a memory; take network=mlp"),
    ("method=mixing guide=random method.transforms.mixing.weight=2", "weight=2 must be at most 1"),
    ("track=unseen", "Could not override 'track'. No match in the defaults list"),
    ("+track=unseen", "+track=unseen has no effect: nothing in this run reads track"),
    ("+preset=paper", "+preset=paper has no effect: nothing in this run reads preset"),
    ("+evaluation.measures.speed.entry=speed", "measures.speed=speed is no entry of the env"),
    ("evaluation.measures.speed=speed", "write evaluation.measures.speed.entry=ENTRY"),
    ("evaluation.measures.speed.entrry=reward", "no key entrry; evaluation.measures.speed"),
    ("evaluation.measures.steps.entry=reward", "steps is already a column of the tables"),
    ("guide.controller.of=odd_parts:first", "it belongs to guide=controller: write"),
]
OTHER_ENVS = [
    ("env.id=odd_parts:Plain", "it belongs to env=gym: write env=gym env.id=VALUE"),
    ("env=odd_parts:Plain", "for an env of Gymnasium write env=gym env.id=odd_parts:Plain"),
    ("env=gym", "env.id must be given: write env.id=VALUE"),
    ("env=torchrl env.of._target_=odd_parts.Plain", "of makes Plain, which is no env of TorchRL"),
]


def answer(*words):
    """Return the sentence that refuses the words of a command line, or an empty string."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            config = compose_train([*words, "run_dir=run"])
            check(config)
            check_read(config, words)
    except Exception as error:
        from_hydra = isinstance(error, (HydraException, OmegaConfBaseException))
        if not from_hydra and not is_no_bug(error):
            raise
        return sentence(error)
    return ""


def in_gym(env, *words):
    return answer("env=gym", f"env.id=odd_parts:{env}", *SMALL, "method=ppo", *words)


@pytest.mark.parametrize(("of", "expected"), NAMES)
def test_odd_name_of_a_controller_is_answered(of, expected):
    assert expected in in_gym("Plain", "guide=controller", f"guide.controller.of={of}")


@pytest.mark.fast(8)
@pytest.mark.parametrize(("words", "expected"), WORDS)
def test_odd_word_is_answered(words, expected, caplog):
    caplog.set_level(logging.CRITICAL)
    assert expected in in_gym("Plain", *words.split())


@pytest.mark.parametrize(("words", "expected"), OTHER_ENVS)
def test_odd_env_is_answered(words, expected):
    assert expected in answer(*words.split(), "method=ppo")


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
    seen = []
    step = odd_parts.Acts.step

    def noted(self, action):
        seen.append(float(np.asarray(action).reshape(-1)[0]))
        return step(self, np.zeros(1))

    monkeypatch.setattr(odd_parts.Acts, "step", noted)
    words = ["env=gym", "env.id=odd_parts:Acts", f"+env.options.space={space}", *SMALL]
    words += ["guide=controller", f"guide.controller.of=odd_parts:{of}", "method=guide"]
    env, policy = env_maker(compose_train([*words, "run_dir=run"])).guided(1, "test")
    with torch.no_grad():
        env.rollout(3, policy)
    assert seen == [given] * 3
