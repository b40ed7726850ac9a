"""A word that nothing in a run reads is refused, by all that take words."""

import pytest
from programs import called

import coil_rl
from coil_rl import UserError, compose_train
from coil_rl.config.unread import check_read

GUIDE = "method=guide trains nothing; leave it out"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("proxy.seed=3", "proxy.seed=3 has no effect: method=coil trains no guides"),
        ("preset.perception.scale=2", "nothing in this run reads preset.perception.scale"),
        ("method=dagger budget.minibatches=3", "nothing in this run reads budget.minibatches"),
        ("learner=sac training.learning_rate=1", "reads training.learning_rate; leave it out"),
        ("training.imitation_env.assignment=random", "reads training.imitation_env.assignment"),
        ("training.tests.starts=5", "this run compares no policies while it trains"),
        ("recording=drive.mcap", "nothing in this run reads recording; leave it out"),
        ("method=guide learner.gamma=0.9", GUIDE),
        ("method=guide learner=sac", GUIDE),
        ("method=guide training.noise_correlation=0.5", GUIDE),
        ("method=guide budget.num_envs=3", GUIDE),
        ("method=guide budget.frames=100", GUIDE),
        ("method=guide evaluation.curve.points=2", GUIDE),
        ("method=guide logger=csv", GUIDE),
        ("action=choices training.noise_correlation=0.5", "the actions of this env are choices"),
        ("method=oil training.noise_correlation=0.5", "method=oil imitates, and explores without"),
        (
            "method=ppo +degrade@evaluation.advice.zeroed=zeroed",
            "method=ppo gives the agent no adv",
        ),
        (
            "method=dynamic_coil_sequential +degrade@evaluation.advice.zeroed=zeroed",
            "gives the agent no advice that could be degraded; leave it out",
        ),
    ],
)
def test_override_that_nothing_reads_is_refused(words, message, tmp_path):
    refused = called("train", *words.split(), cwd=tmp_path, code=2).stderr
    assert message in refused


@pytest.mark.parametrize("word", ["method=coil_anchored", "delivery=tested"])
def test_cases_of_comparisons_are_read_where_policies_are_compared(word):
    check_read(compose_train([word]), ["training.tests.starts=5"])


def unread(*words, shared=False):
    """Return the reason why the last of some words is not read; empty if it is."""
    try:
        check_read(compose_train(list(words)), words[-1:], shared=shared)
    except UserError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("word", "read"),
    [
        ("learner.gamma=0.9", False),
        ("network=mlp", False),
        ("training.learning_rate=1", False),
        ("budget.minibatches=3", False),
        ("checkpoint_every=3", False),
        ("budget.frames=1000", True),
        ("training.tests.starts=5", True),
        ("evaluation.curve.points=2", True),
        ("preset.rate=10", True),
    ],
)
def test_search_of_the_numbers_of_a_guide_reads_nothing_of_a_learner(word, read):
    assert (unread("method=tune", word) == "") == read


@pytest.mark.parametrize(
    "word",
    [
        "guide.spline.gain=0.5",
        "env.rate=10",
        "preset.rate=10",
        "track.test.count=2",
        "evaluation.gif=false",
        "seed=3",
        "device=cpu",
        "label=mine",
        "disturb=[late]",
        "degrade=[noisy]",
    ],
)
def test_guide_alone_reads_what_says_how_it_drives(word):
    assert unread("method=guide", "track=generated", word) == ""


def test_value_that_an_env_refers_to_is_read_by_a_guide_alone():
    words = ["method=guide", "env.time_limit=${budget.steps}", "budget.steps=3"]
    assert unread(*words) == ""
    assert "method=guide trains nothing" in unread("method=guide", "budget.steps=3")


@pytest.mark.parametrize(
    "word", ["budget.frames=100", "learner.gamma=0.9", "+degrade@evaluation.advice.zeroed=zeroed"]
)
def test_word_that_another_method_of_a_sweep_reads_is_accepted(word):
    assert unread("method=guide", word)
    assert unread("method=guide", word, shared=True) == ""
    assert unread("method=coil", word) == ""


def test_noise_is_read_where_actions_are_numbers():
    assert unread("method=coil", "training.noise_correlation=0.5") == ""


def test_words_from_python_are_read_too(tmp_path):
    words = ["logger=none", "proxy.seed=3"]
    folder = tmp_path / "run"
    with pytest.raises(
        UserError, match=r"proxy\.seed=3 has no effect: method=ppo trains no guides"
    ):
        coil_rl.prepare("cone_track", method="ppo", folder=folder, overrides=words)
    with pytest.raises(UserError, match=r"budget\.frames=64 has no effect: method=guide trains"):
        coil_rl.prepare("cone_track", guide="spline", method="guide", frames=64, folder=folder)
    assert not folder.exists()
