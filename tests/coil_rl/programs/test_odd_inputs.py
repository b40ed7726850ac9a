"""Odd inputs of all kinds end in one sentence, or in the right number."""

import logging
import warnings

import numpy as np
import odd_parts
import pytest
import torch
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException
from programs import called

from coil_rl.config.build import env_maker
from coil_rl.config.check import check_parts
from coil_rl.config.python import compose_train
from coil_rl.config.sentences import is_no_bug, sentence
from coil_rl.config.unread import check_read
from coil_rl.envs.gymnasium_env import GymnasiumEnv

SMALL = ["evaluation.cases=2", "evaluation.curve.num_envs=2", "logger=none"]
FAULTS = [  # of an env: the part of its answer, the kind in `odd_parts.ODD`, the sentence
    ("reward", "text", "step 1): the reward is 'high', not one number"),
    ("reward", "infinite", "step 1): the reward is inf, not a finite number"),
    ("reward", "complex", "step 1): the reward is (1+2j), not one number"),
    ("reward", "two", "step 1): the reward is [1.0, 2.0], not one number"),
    ("reward", "dict", "step 1): the reward is {'a': 1}, not one number"),
    ("reward", "array1", "step 1): the reward is [0.5], not one number"),
    ("reward", "bytes", "step 1): the reward is b'a', not one number"),
    ("terminated", "none", "terminated is None, not True or False"),
    ("terminated", "half", "terminated is 0.5, not True or False"),
    ("truncated", "text", "truncated is 'high', not True or False"),
    ("truncated", "two", "truncated is [1.0, 2.0], not True or False"),
    ("info", "none", "info of step is None, not a dictionary"),
    ("info", "pairs", "info of step is [('a', 1)], not a dictionary"),
    ("step", "none", "step returned None, not the five of Gymnasium"),
    ("step", "six", "step returned 6 values, not the five of Gymnasium"),
    ("step", "dict", "step returned {'a': 1}, not the five of Gymnasium"),
    ("reset", "three", "step 0): reset returned 3 values, not the two of Gymnasium"),
    ("reset", "long", "reset returned [0.0, 0.0, 0.0], not the two of Gymnasium"),
    ("reset", "empty", "reset returned 0 values, not the two of Gymnasium"),
    ("first", "column", "the observation has the shape [1, 2], but its space has [2]"),
    ("first", "none", "the observation is None, not an array of numbers"),
    ("observation", "matrix", "the observation has the shape [2, 1], but its space has [2]"),
    ("observation", "long", "the observation has the shape [3], but its space has [2]"),
    ("observation", "no_number", "the observation has the shape [], but its space has [2]"),
    ("observation", "objects", "the observation is [None, 1], not an array of numbers"),
    ("observation", "set", "the observation is {1}, not an array of numbers"),
]
RAISED = [
    ("reset", "KeyError", "step 0): reset raised KeyError: "),
    ("step", "ZeroDivisionError", "step 1): step raised ZeroDivisionError: the valve is stuck"),
    ("step", "StopIteration", "step 1): step raised StopIteration: the valve is stuck"),
    ("step", "SystemExit", "step 1): step raised SystemExit: the valve is stuck"),
    ("init", "OSError", "cannot be made: it raised OSError: the valve is stuck"),
    ("init", "RuntimeError", "cannot be made: it raised RuntimeError: the valve is stuck"),
]
ACTIONS = [  # spaces of actions that no policy can have
    ("point", "number 0 of the action of Acts has the bounds 3.0 and 3.0"),
    ("many", "of whole numbers, which are choices, but only up to 32 of each"),
    ("dict", "the action of Acts is a Dict space: replace it with a wrapper"),
    ("tuple", "the action of Acts is a Tuple space: replace it with a wrapper"),
    ("text", "the action of Acts is a Text space: replace it with a wrapper"),
    ("sequence", "the action of Acts is a Sequence space: replace it with a wrapper"),
    ("zero", "the action of Acts has the shape [0]: it has no number"),
    ("missing", "the env Acts has no action_space: set it in its __init__"),
]
CONTROLLERS = [
    ("none", "plane", "the action is None, not an array of numbers"),
    ("text", "plane", "the action is 'left', not an array of numbers"),
    ("nan", "plane", "the action is [nan], which is not finite"),
    ("state_too", "plane", "return the action alone, without a state"),
    ("two", "plane", "odd_parts:two (row 0): it returned ["),
    ("two", "plane", "which has the shape [2], but must have [1]"),
    ("raises", "plane", "it raised RuntimeError: no map loaded"),
    ("exits", "plane", "it raised SystemExit: 3"),
    ("keyed", "plane", "not an array of numbers"),
    ("TwoNumbers", "plane", "odd_parts:TwoNumbers (row 0, step 0): act returned [1.0, 2.0], which"),
    ("TwoNumbers", "plane", "which has the shape [2], but must have [1]"),
    ("NoAct", "plane", "is a class without act(observation); give it this method"),
    ("NeedsPath", "plane", "takes (path), but is called with ()"),
    ("LateNone", "plane", "(row 0, step 1): the action is None, not an array of numbers"),
    ("BadReset", "plane", "(row 0, step 0): reset raised KeyError: 'gain'"),
    ("constant", "plane", "is int; name a class, a function, an object with act(observation)"),
    ("ODD", "plane", "is dict; name a class, a function"),
    (
        "half",
        "from5",
        "it returned [0.5], which is neither a number from [5] to [7] nor a one-hot vector",
    ),
    ("seven", "from_minus", "which is neither a number from [-1] to [1] nor a one-hot"),
    ("six", "flags", "it returned [6], which has the shape [1], but must have [4]"),
    ("two", "multi_start", "is neither a number from [1, 10] to [3, 11] nor a one-hot vector"),
    ("two", "matrix", "which has the shape [2], but must have [2, 2]"),
]
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
    ("env.id=no_such-v3", "if a package registers it, write PACKAGE:no_such-v3"),
    ("env.id=7", "env.id=7 must be a valid string or callable"),
    ("+env.options.speed=3", "it raised TypeError: Plain() takes no arguments"),
    ("env.max_steps=-5", "max_steps=-5 must be at least 1 and finite"),
    ("env.info=speed", "env.info='speed' must be a list"),
    ("observes=observation", "observes=observation must be a list; write observes=[observation]"),
    ("observes=[speed]", "the env has no entry speed to observe; it has observation"),
    ("budget.frames=1.5", "budget.frames=1.5 must be a whole number"),
    ("budget.frames=many", "budget.frames=many must be a whole number"),
    ("budget.steps=100000000", "budget.steps=100000000 must be at most 65536"),
    ("training.noise_correlation=much", "training.noise_correlation=much must be a number"),
    ("compile=maybe", "compile=maybe must be true or false"),
    ("seed=one", "seed=one must be a whole number"),
    ("label=a/b", "label=a/b cannot be used: it must not be empty"),
    ("evaluation.cases=two", "evaluation.cases=two must be at least 1, or the names of the"),
    ("learner.hidden=64", "learner.hidden=64 must be a list"),
    ("learner=[ppo,sac]", "chooses several files of a group that takes one; for a run with each"),
    ("method=[ppo,coil]", "write -m method=ppo,coil"),
    ("degrade=[noisy]", "degrade=[noisy] has no effect, because there is no guide"),
    ("network=gru learner=sac", "SAC cannot train a network with a memory; take network=mlp"),
    ("method=mixing guide=random method.transforms.mixing.weight=2", "weight=2 must be at least 0"),
    ("track=unseen", "only the cone world (env=cone_track) has the group track; leave it out"),
    ("+track=unseen", "+track=unseen has no effect: nothing in this run reads track"),
    ("+preset=paper", "+preset=paper has no effect: nothing in this run reads preset"),
    ("+evaluation.measures.speed.entry=speed", "measures.speed=speed is no entry of the env"),
    ("evaluation.measures.speed=speed", "write evaluation.measures.speed.entry=ENTRY"),
    ("evaluation.measures.speed.entrry=reward", "no key entrry; evaluation.measures.speed"),
    ("evaluation.measures.steps.entry=reward", "steps is already a column of the tables"),
    ("~evaluation.cases", "evaluation.cases cannot be left out; give it another value"),
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
            check_parts(config)
            check_read(config, words)
    except Exception as error:
        from_hydra = isinstance(error, (HydraException, OmegaConfBaseException))
        if not from_hydra and not is_no_bug(error):
            raise
        return sentence(error)
    return ""


def in_gym(env, *words):
    return answer("env=gym", f"env.id=odd_parts:{env}", *SMALL, "method=ppo", *words)


def test_the_table_has_a_hundred_inputs():
    assert sum(map(len, (FAULTS, RAISED, ACTIONS, CONTROLLERS, NAMES, WORDS, OTHER_ENVS))) >= 99


@pytest.mark.parametrize(("part", "kind", "expected"), FAULTS)
def test_odd_answer_of_an_env_is_named(part, kind, expected):
    said = in_gym("Odd", f"+env.options.part={part}", f"+env.options.kind={kind}")
    assert expected in said
    assert "the env Odd (row 0, seed 0, " in said


@pytest.mark.parametrize(("call", "error", "expected"), RAISED)
def test_exception_of_an_env_is_named(call, error, expected):
    said = in_gym("Raises", f"+env.options.call={call}", f"+env.options.error={error}")
    assert expected in said


@pytest.mark.parametrize(("space", "expected"), ACTIONS)
def test_odd_action_space_is_named(space, expected):
    assert expected in in_gym("Acts", f"+env.options.space={space}")


@pytest.mark.parametrize(("name", "space", "expected"), CONTROLLERS)
def test_odd_controller_is_named(name, space, expected):
    words = ["guide=controller", f"guide.controller.of=odd_parts:{name}", "method=coil"]
    said = in_gym("Acts", f"+env.options.space={space}", *words)
    assert expected in said
    assert f"odd_parts:{name}" in said or "guide.controller" in said


@pytest.mark.parametrize(("of", "expected"), NAMES)
def test_odd_name_of_a_controller_is_answered(of, expected):
    assert expected in in_gym("Plain", "guide=controller", f"guide.controller.of={of}")


@pytest.mark.parametrize(("words", "expected"), WORDS)
def test_odd_word_is_answered(words, expected, caplog):
    caplog.set_level(logging.CRITICAL)
    assert expected in in_gym("Plain", *words.split())


@pytest.mark.parametrize(("words", "expected"), OTHER_ENVS)
def test_odd_env_is_answered(words, expected):
    assert expected in answer(*words.split(), "method=ppo")


@pytest.mark.parametrize(
    ("part", "kind", "reward"),
    [
        ("reward", "decimal", 0.5),
        ("reward", "fraction", 0.5),
        ("reward", "yes", 1.0),
        ("reward", "int", 2.0),
        ("reward", "array", 0.5),
        ("reward", "npbool", 1.0),
    ],
)
def test_odd_number_is_the_right_reward(part, kind, reward):
    env = GymnasiumEnv(odd_parts.Odd, options={"part": part, "kind": kind})
    assert env.rollout(3)["next", "reward"].view(-1).tolist() == [reward] * 3


@pytest.mark.parametrize(("kind", "steps"), [("one", 1), ("npbool", 1), ("yes", 1), ("zero", 10)])
def test_odd_flag_ends_the_episode_where_it_is_true(kind, steps, monkeypatch):
    monkeypatch.setitem(odd_parts.ODD, "zero", 0)
    env = GymnasiumEnv(odd_parts.Odd, options={"part": "terminated", "kind": kind})
    assert env.rollout(20).shape == (1, steps)


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


@pytest.mark.parametrize(("words", "expected"), [WORDS[0], WORDS[7], WORDS[18], WORDS[24]])
def test_program_ends_with_the_sentence_and_exit_code_2(words, expected, tmp_path):
    plain = ["env=gym", "env.id=odd_parts:Plain", "method=ppo", *SMALL]
    refused = called("train", *plain, *words.split(), cwd=tmp_path, code=2).stderr
    assert expected in refused
    assert len(refused.splitlines()) == 1
    assert not list(tmp_path.iterdir())
