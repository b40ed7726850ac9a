"""An exported policy acts as the controller of its run does, or is refused in one sentence."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from learned_runs import ON_POLICY, REPLAY, learned
from programs import shipped
from torchrl.envs import Transform

import coil_rl
from coil_rl.export import write
from coil_rl.export.contract import CONTRACT, DRIVER, ONNX, TORCH
from coil_rl.export.parity import heard
from coil_rl.learners.anchor import hold_of
from coil_rl.run import checkpoint
from coil_rl.run.delivery import GUIDE

METHODS = shipped("method")
OBSERVATIONS = 30
MEMORY = {f"guide_state.controller.{name}" for name in ("integral", "wish")}  # of BatchedPI


pytestmark = pytest.mark.usefixtures("thermostat")


def exported(folder, method, *overrides, **parts):
    run = coil_rl.open_run(learned(folder / "run", method, *overrides, **parts))
    return run, coil_rl.export_policy(run, folder / "exported", observations=OBSERVATIONS)


def same_actions(run, policy, observations, *, outside=False):
    """Check that both act alike in an episode; the guides of the policy may be outside."""
    controller = run.controller()
    if outside:
        controller.guides.heard = {}
    for _ in range(2):
        controller.reset()
        policy.reset()
        for observation in observations:
            own = controller.act(observation)
            given = heard(controller.guides)[0].numpy() if outside else None
            np.testing.assert_allclose(policy.act(observation, given), own, rtol=0, atol=1e-5)


def rooms(count=12):
    generator = np.random.default_rng(0)
    return generator.normal([-3, 5], 2, (count, 2)).astype(np.float32)


@pytest.mark.slow
def test_torch_guide_with_memory_is_inside(tmp_path):
    guide = "thermostat.control:BatchedPI"
    run, policy = exported(tmp_path, "coil", "learner.normalise=true", guide=guide)
    found = policy.contract["guide"]
    assert (found["place"], found["names"]) == ("inside", ["controller"])
    assert found["settings"]["controller"]["of"] == guide
    assert [entry["name"] for entry in policy.contract["inputs"]] == ["observation"]
    states = {entry["input"] for entry in policy.contract["state"]}
    assert states == {f"state.{name}" for name in MEMORY | {"last_action"}}
    same_actions(run, policy, rooms())


@pytest.mark.slow
def test_python_guide_is_an_input_in_the_unit_of_the_env(tmp_path, capsys):
    run, policy = exported(tmp_path, "residual")
    assert "Python object for each row (thermostat.control:PI)" in capsys.readouterr().out
    assert policy.contract["guide"]["place"] == "outside"
    advice = policy.contract["inputs"][-1]
    assert (advice["name"], advice["shape"]) == ("guide_action", [1, 1])
    observation = rooms(1)[0]
    with pytest.raises(ValueError, match="guide of this policy is outside: give its action"):
        policy.act(observation)
    same_actions(run, policy, rooms(), outside=True)


@pytest.mark.slow
def test_python_guide_that_the_policy_does_not_read_is_absent(tmp_path, capsys):
    run, policy = exported(tmp_path, "kickstart")
    assert policy.contract["guide"] == {"place": "absent"}
    assert [entry["name"] for entry in policy.contract["inputs"]] == ["observation"]
    assert "stays outside" not in capsys.readouterr().out
    same_actions(run, policy, rooms())


@pytest.mark.slow
@pytest.mark.parametrize("guide", ["PI", "proportional"])
def test_guide_that_was_handed_over_is_said_to_be_no_policy(guide, tmp_path, capsys):
    folder = learned(
        tmp_path / "run", "coil", "delivery=tested", guide=f"thermostat.control:{guide}"
    )
    checkpoint.save({GUIDE: torch.tensor(0)}, folder / "policy_handed_over.pt")
    run = coil_rl.open_run(folder)
    policy = coil_rl.export_policy(run, tmp_path / "exported", observations=OBSERVATIONS)
    said = capsys.readouterr().out
    assert "what the run handed over is guide controller itself, not a learned policy" in said
    assert ("its file only passes guide_action on" in said) == (guide == "PI")
    assert "policy=last exports the last learned policy" in said
    assert policy.contract["policy"]["acts"] == "guide controller itself, not a learned policy"
    last = coil_rl.export_policy(run, tmp_path / "last", which="last", observations=OBSERVATIONS)
    assert last.contract["policy"]["acts"] == "a learned policy"
    assert "itself" not in capsys.readouterr().out


@pytest.mark.slow
def test_first_policy_that_was_handed_over_is_said_to_have_learned_nothing(tmp_path, capsys):
    folder = learned(tmp_path / "run", "coil_anchored", guide="thermostat.control:proportional")
    report = json.loads((folder / "delivery.json").read_text())
    (folder / "delivery.json").write_text(json.dumps(report | {"policy": "first"}))
    shutil.copy(folder / "policy_last.pt", folder / "policy_handed_over.pt")
    run = coil_rl.open_run(folder)
    policy = coil_rl.export_policy(run, tmp_path / "exported", observations=OBSERVATIONS)
    said = "the first policy, which is its guide and has learned nothing"
    assert policy.contract["policy"]["acts"] == said
    assert f"Handed over is {said}" in policy.contract["policy"]["chosen"]
    assert f"what the run handed over is {said}; policy=last" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_method_is_exported(method, tmp_path):
    tuned = {"tune": ("thermostat.control:proportional", ["tune={kp: [0.1, 1]}"])}
    guide, words = tuned.get(method, ("thermostat.control:Feedforward", []))
    run, policy = exported(tmp_path, method, *words, guide=guide)
    # The guides that dynamic COIL learns are networks of the policy itself, and an anchored policy
    # asks none that it does not hold.
    network = run.policy()
    hold = None if network is None else hold_of(network)
    without = method == "ppo" or method.startswith("dynamic_coil")
    without |= hold is not None and not hold.held
    assert policy.contract["guide"]["place"] == ("absent" if without else "inside")
    assert ("tuned" in policy.contract["guide"]) == (method == "tune")
    same_actions(run, policy, rooms())


@pytest.mark.slow
def test_controller_beside_its_env_is_outside(tmp_path):
    words = ["+env.controllers.day=thermostat.control:KnowsTheDay"]
    words += ["guide.entry.key=[controller,day]"]
    _, policy = exported(tmp_path, "coil", *words, guide="entry")
    found = policy.contract["guide"]
    assert found["place"] == "outside"
    assert re.search("draws|Python|beside", found["reason"])


PAST = ["+transform=last_action", "method.transforms.last_action.steps=3"]
GRU = ["network=gru", "learner.minibatches=1"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "guide", "overrides", "remembered"),
    [
        ("coil", "Feedforward", ["learner.squash=false"], set()),
        ("coil", "Feedforward", ["learner=sac"], set()),
        ("coil", "Feedforward", ["action=choices"], set()),
        ("coil", "Feedforward", ["action=choices", "learner=dqn"], set()),
        ("coil", "Feedforward", ["degrade=[biased]"], set()),
        ("coil", "Feedforward", ["network=mlp"], set()),
        *((method, "Feedforward", GRU, {"policy_state"}) for method in ("coil", "residual")),
        ("jump_start", "Feedforward", GRU, {"policy_state"}),
        ("ppo", None, [*PAST, "method.observes=[last_action]"], {"past.last_action"}),
        # The memory of this guide reads the executed action.
        (
            "residual",
            "BatchedPI",
            [*PAST, "method.observes=[guide_action,last_action]"],
            {"past.last_action", "last_action"} | MEMORY,
        ),
    ],
)
def test_other_heads_and_memories_are_exported(method, guide, overrides, remembered, tmp_path):
    options = REPLAY if overrides[-1] in ("learner=sac", "learner=dqn") else ON_POLICY
    guide = guide and f"thermostat.control:{guide}"
    run, policy = exported(tmp_path, method, *overrides, options=options, guide=guide)
    state = {entry["input"]: entry["shape"] for entry in policy.contract["state"]}
    assert set(state) == {f"state.{name}" for name in remembered}
    assert state.get("state.past.last_action", [3]) == [3]
    same_actions(run, policy, rooms())
    before = policy.state_dict()
    action = policy.act(rooms(1)[0])
    policy.load_state_dict(json.loads(json.dumps(before)))
    assert policy.act(rooms(1)[0]) == action


@pytest.mark.slow
def test_delayed_advice_is_refused(tmp_path):
    run = coil_rl.open_run(learned(tmp_path / "run", "coil", "degrade=[delayed]"))
    with pytest.raises(coil_rl.UserError, match="DelayedAdvice degrades the advice"):
        coil_rl.export_policy(run, tmp_path / "exported", observations=5)


class OwnPast(Transform):
    """A transform that remembers, and says so."""

    needs_past = True


@pytest.mark.slow
def test_transform_that_remembers_is_refused_before_the_drive(tmp_path, monkeypatch):
    run = coil_rl.open_run(learned(tmp_path / "run", "ppo"))
    controller = run.controller()
    controller.env.append_transform(OwnPast())
    monkeypatch.setattr(type(run), "controller", lambda *_: controller)
    monkeypatch.setattr(write, "record", None)
    with pytest.raises(coil_rl.UserError, match="OwnPast remembers earlier steps"):
        coil_rl.export_policy(run, tmp_path / "exported", observations=5)


@pytest.mark.slow
def test_wrong_file_is_not_written(tmp_path, monkeypatch):
    run = coil_rl.open_run(learned(tmp_path / "run", "ppo"))
    monkeypatch.setattr(write, "LIMIT", -1.0)
    with pytest.raises(coil_rl.UserError, match="depends on more than its inputs"):
        coil_rl.export_policy(run, tmp_path / "exported", observations=5)
    assert not (tmp_path / "exported").exists()


@pytest.mark.slow
def test_files_hold_no_path_of_this_machine(tmp_path):
    _, policy = exported(tmp_path, "ppo")
    folder = policy.file.parent
    assert sorted(path.name for path in folder.iterdir()) == [CONTRACT, DRIVER, ONNX, TORCH]
    root = str(Path(coil_rl.__file__).parents[1]).encode()
    for path in folder.iterdir():
        content = path.read_bytes()
        for text in (root, b"site-packages", b".py:", str(tmp_path).encode()):
            assert text not in content, f"{path.name} has {text!r}"
    program = torch.export.load(folder / TORCH).module()
    observation = rooms(3)
    own = policy.session({"observation": observation})[0]
    np.testing.assert_allclose(program(torch.from_numpy(observation))[0], own, rtol=0, atol=1e-5)
