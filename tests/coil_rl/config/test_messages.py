"""What people type first is answered by the right key, file or command."""

from pathlib import Path

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
        (
            "network=mlp network.hidden=[8]",
            "did you mean learner.hidden or learner.network.hidden?",
        ),
        ("frames=1000", "did you mean budget.frames?"),
        ("total_timesteps=1000", "did you mean budget.frames?"),
        ("budget.frames=1e6", "must be a whole number; write budget.frames=1_000_000"),
        ("env=twotank:TwoTank-v0", "write env=gym env.id=twotank:TwoTank-v0"),
        ("env=CartPole-v1", "write env=gym env.id=CartPole-v1"),
        (
            "guide=twotank.control:PI",
            "write guide=controller guide.controller.of=twotank.control:PI",
        ),
        (
            "guide.controller.of=twotank.control:PI",
            "it belongs to guide=controller: write guide=controller guide.controller.of=VALUE",
        ),
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


def test_method_file_without_its_package_line_is_told_the_line(tmp_path):
    file = Path(tmp_path / "conf" / "method" / "mine.yaml")
    file.parent.mkdir(parents=True)
    file.write_text("defaults: [coil, _self_]\nmethod: {name: mine}\nlearner: {gamma: 0.9}\n")
    arguments = ["--config-dir", str(tmp_path / "conf"), "method=mine"]
    refused = called("train", *arguments, cwd=tmp_path, code=2).stderr
    assert "method/mine.yaml: Hydra puts its keys under method" in refused
    assert "begin the file with the line # @package _global_" in refused
