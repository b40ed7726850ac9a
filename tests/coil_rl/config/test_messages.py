"""What people type first is answered by the right key, file or command."""

import pytest
from programs import called


@pytest.mark.parametrize(
    ("typed", "hint"),
    [
        ("learner.lr=0.1", "did you mean learning_rate?"),
        ("+learner.lr=0.1", "did you mean learning_rate?"),
        ("lr=0.1", "did you mean training.learning_rate or learner.learning_rate?"),
        ("guide.gain=0.5", "did you mean guide.spline.gain?"),
        ("network.hidden=[32,32]", "did you mean learner.hidden?"),
        ("network=mlp network.hidden=[8]", "mean learner.hidden or learner.network.hidden?"),
        ("frames=1000", "did you mean budget.frames?"),
        ("total_timesteps=1000", "did you mean budget.frames?"),
        ("budget.frames=1e6", "must be a whole number; write budget.frames=1_000_000"),
        ("env=twotank:TwoTank-v0", "write env=gym env.id=twotank:TwoTank-v0"),
        ("env=CartPole-v1", "write env=gym env.id=CartPole-v1"),
        ("guide=tank.control:PI", "write guide=controller guide.controller.of=tank.control:PI"),
        ("guide.controller.of=a:PI", "write guide=controller guide.controller.of=VALUE"),
        ("degrade.noisy.sigma=0.1", "write degrade=[noisy] degrade.noisy.sigma=VALUE"),
        ("run=outputs/tank", "to go on with a run write resume=FOLDER"),
    ],
)
def test_mistake_is_answered_by_what_to_write(typed, hint):
    refused = called("train", *typed.split(), code=2).stderr
    assert hint in refused
    assert len(refused.splitlines()) == 1


def test_key_that_was_typed_is_no_hint():
    words = ["env=gym", "env.id=CartPole-v1", "guide=controller", "env.options={sutton: true}"]
    refused = called("train", *words, code=2).stderr
    assert "there is no key env.options.sutton" in refused
    assert refused.endswith("+env.options.sutton=VALUE adds it\n")


def test_unknown_argument_of_a_part_is_not_said_to_be_added_by_a_plus():
    assert "adds it" not in called("train", "learner.lr=0.1", code=2).stderr
