"""A word that nothing in a run reads is refused, by all that take words."""

import pytest
from programs import SHORT_LAP, called

import coil_rl
from coil_rl import UserError, compose_train
from coil_rl.config.unread import check_read

GUIDE = "(method=guide); leave it out"


def unread(*words):
    """Return the reason why the last of some words is not read; empty if it is."""
    try:
        check_read(compose_train(list(words)), words[-1:])
    except UserError as error:
        return str(error)
    return ""


@pytest.mark.fast(4)
@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("method=dagger budget.minibatches=3", "nothing in this run reads budget.minibatches"),
        (
            "learner=sac training.learning_rate=1",
            "reads training.learning_rate (method=coil); leave it out",
        ),
        ("training.imitation_env.assignment=random", "reads training.imitation_env.assignment"),
        ("training.tests.starts=5", "reads training.tests.starts (method=coil)"),
        ("recording=drive.mcap", "nothing in this run reads recording (method=coil); leave it out"),
        ("method.needs_guide=false", "the file of method=coil says whether its policy needs a"),
        ("method=guide learner.gamma=0.9", GUIDE),
        ("method=guide learner=sac", GUIDE),
        ("method=guide training.noise_correlation=0.5", GUIDE),
        ("method=guide budget.num_envs=3", GUIDE),
        ("method=guide budget.frames=100", GUIDE),
        ("method=guide evaluation.curve.points=2", GUIDE),
        ("method=guide logger=csv", GUIDE),
        (
            "action=choices training.noise_correlation=0.5",
            "reads training.noise_correlation (method=coil)",
        ),
        (
            "method=oil training.noise_correlation=0.5",
            "reads training.noise_correlation (method=oil)",
        ),
        (
            "method=ppo +degrade@evaluation.advice.zeroed=zeroed",
            "reads evaluation.advice.zeroed (method=ppo)",
        ),
        (
            "method=dynamic_coil_sequential +degrade@evaluation.advice.zeroed=zeroed",
            "reads evaluation.advice.zeroed (method=dynamic_coil_sequential)",
        ),
    ],
)
def test_override_that_nothing_reads_is_refused(words, message):
    assert message in unread(*words.split())


@pytest.mark.parametrize("word", ["method=coil_anchored", "delivery=tested"])
def test_cases_of_comparisons_are_read_where_policies_are_compared(word):
    check_read(compose_train([word]), ["training.tests.starts=5"])


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
    assert "(method=guide)" in unread("method=guide", "budget.steps=3")


@pytest.mark.slow
def test_each_run_of_a_sweep_says_what_it_does_not_read(tmp_path):
    words = ["-m", "method=guide", "seed=0,1", *SHORT_LAP, "evaluation.gif=false"]
    said = called("train", *words, "learner.gamma=0.9", cwd=tmp_path).stderr
    assert said.count("learner.gamma=0.9 has no effect: nothing in this run reads") == 2


def test_noise_is_read_where_actions_are_numbers():
    assert unread("method=coil", "training.noise_correlation=0.5") == ""


@pytest.mark.slow
def test_words_from_python_are_read_too(tmp_path):
    words = ["logger=none", "proxy.seed=3"]
    folder = tmp_path / "run"
    with pytest.raises(
        UserError, match=r"proxy\.seed=3 has no effect: nothing in this run reads proxy\.seed"
    ):
        coil_rl.prepare("cone_track", method="ppo", folder=folder, overrides=words)
    with pytest.raises(UserError, match=r"budget\.frames=64 has no effect: .*method=guide"):
        coil_rl.prepare("cone_track", guide="spline", method="guide", frames=64, folder=folder)
    assert not folder.exists()
