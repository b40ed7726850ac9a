"""An exported policy in onnxruntime: its contract is checked, and so is what it is given."""

import json

import numpy as np
import pytest
import torch
from exported_sums import model, write
from torchrl.data import Bounded, Categorical, Unbounded

from coil_rl.errors import UserError
from coil_rl.export.contract import CONTRACT, ONNX, VERSION
from coil_rl.export.guide import ExportedGuide
from coil_rl.export.policy import ExportedPolicy
from coil_rl.transforms.action_space import ActionSpace


def test_state_goes_from_step_to_step_until_a_reset(tmp_path):
    policy = ExportedPolicy(write(tmp_path))
    assert policy.act([2.0, 3.0], 10.0) == 16.0
    assert policy.act({"observation": [0.0, 0.0], "guide_action": [1.0]}) == 17.0
    saved = json.loads(json.dumps(policy.state_dict()))
    assert policy.act([0.0, 0.0], 0.0) == 17.0
    policy.load_state_dict(saved)
    assert policy.act([1.0, 0.0], 0.0) == 18.0
    with pytest.raises(ValueError, match="the state has other, but this policy remembers state"):
        policy.load_state_dict({"other": [[1.0]]})
    policy.reset()
    action = policy.act([0.0, 0.0], 0.0)
    assert (action.dtype, action.shape, action[0]) == (np.float64, (1,), 1.0)


def inside(contract):
    contract["guide"] = {"place": "inside", "names": ["sum"]}


def named(contract):
    contract["inputs"][0]["from"] = {"path": ["observation"], "choices": [], "start": []}


def whole(contract):
    contract["inputs"][0]["from"] = {"path": [], "choices": [], "start": []}


@pytest.mark.parametrize(
    ("change", "observation", "advice", "message"),
    [
        (
            whole,
            [1.0, 2.0, 3.0],
            0.0,
            r"observation is \[1.0, 2.0, 3.0\], but must be \[2\] finite",
        ),
        (
            whole,
            [1.0, np.nan],
            0.0,
            r"observation is \[1.0, nan\], but must be \[2\] finite numbers",
        ),
        (whole, ["a", "b"], 0.0, r"observation is \['a', 'b'\], but must be .* numbers of float32"),
        (named, {"other": [1.0, 2.0]}, 0.0, "the observation lacks observation"),
        (whole, {"guide_action": [1.0]}, 0.0, "the observation lacks observation"),
        (whole, [1.0, 2.0], None, "the guide of this policy is outside"),
        (whole, [1.0, 2.0], [1.0, 2.0], r"guide_action is \[1.0, 2.0\], but must be \[1\] finite"),
        (inside, [1.0, 2.0], [1.0], "takes no guide_action: its guide is inside; leave"),
    ],
)
def test_what_does_not_fit_is_refused(change, observation, advice, message, tmp_path):
    policy = ExportedPolicy(write(tmp_path, change))
    with pytest.raises(ValueError, match=message):
        policy.act(observation, advice)


def matrix(guides):
    """Return a change of the contract: the action is a matrix, and so many guides are outside."""

    def change(contract):
        contract["inputs"][1]["shape"] = [guides, 4]
        contract["outputs"][0]["space"]["shape"] = [2, 2]
        contract["guide"]["names"] = ["sum"] * guides

    return change


@pytest.mark.parametrize(
    ("guides", "shape"),
    [(1, (1, 4)), (1, (4,)), (1, (2, 2)), (1, (1, 2, 2)), (2, (2, 4)), (2, (2, 2, 2))],
)
def test_advice_may_have_the_shape_of_the_contract_or_of_the_env(guides, shape, tmp_path):
    policy = ExportedPolicy(write(tmp_path))
    matrix(guides)(policy.contract)
    numbers, given = np.arange(4.0 * guides), []
    policy.session = lambda feeds: given.append(feeds["guide_action"]) or [np.zeros((1, 4)), None]
    assert policy.act([1.0, 2.0], numbers.reshape(shape)).shape == (2, 2)
    np.testing.assert_array_equal(given[0], numbers.reshape(1, guides, 4))


@pytest.mark.parametrize(
    ("guides", "shape"), [(1, (4, 1, 2)), (1, (2, 1)), (2, (2, 2)), (2, (4, 2))]
)
def test_advice_of_another_shape_is_refused(guides, shape, tmp_path):
    policy = ExportedPolicy(write(tmp_path))
    matrix(guides)(policy.contract)
    with pytest.raises(ValueError, match=rf"but must be \[{guides}, 4\] finite numbers"):
        policy.act([1.0, 2.0], np.zeros(shape))


def test_choices_are_encoded_as_the_contract_says(tmp_path):
    def of_choices(contract):
        contract["inputs"][0]["from"] = {"path": ["gear"], "choices": [2], "start": [5]}

    policy = ExportedPolicy(write(tmp_path, of_choices))
    assert policy.act({"gear": 6}, 0.0) == 2.0
    with pytest.raises(ValueError, match=r"observation is \[7\], which are no choices of \[2\]"):
        policy.act({"gear": 7}, 0.0)


MISSING = object()


def changed(place, value):
    """Return a change of one part of the contract."""

    def change(contract):
        node = contract
        for part in place[:-1]:
            node = node[part]
        node[place[-1]] = value
        if value is MISSING:
            del node[place[-1]]

    return change


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("format",), "else", "has the format 'else' in version 1"),
        (("version",), VERSION + 1, "in version 2, but this program reads"),
        (("outputs",), MISSING, "contract.json is damaged.*outputs.*coil-export run=RUN"),
        (("files",), MISSING, "contract.json is damaged.*files"),
        (("inputs", 0, "name"), "other", r"Required inputs \(\['observation'\]\) are missing"),
        (("inputs", 0, "shape"), [3], "it fails with .*: observation .* Got: 3 Expected: 2"),
        (("inputs", 0, "shape"), [2, 1], "it fails with .*Invalid rank for input: observation"),
        (("inputs", 0, "shape"), [10**6, 10**6], "is damaged.*inputs.0.shape: .* no shape of at"),
        (("inputs", 0, "shape"), [-1], "is damaged.*inputs.0.shape"),
        (
            ("inputs", 0, "dtype"),
            "int64",
            r"it fails with .*data type.* \(tensor\(int64\)\) , expected",
        ),
        (("inputs", 0, "dtype"), "O", "is damaged.*inputs.0.dtype.* O is no type of numbers"),
        (("inputs", 0, "dtype"), "nothing", "is damaged"),
        (("inputs", 0, "key"), [], "is damaged.*inputs.0.key"),
        (("inputs",), {}, "is damaged.*inputs"),
        (("state", 0, "output"), "action2", "it fails with .*action2"),
        (("state", 0, "first"), "x", "is damaged.*state.0.first"),
        (("state", 0, "first"), [1, 2], "is damaged.*state.0: .*broadcast"),
        (("state", 0, "shape"), [2], "it fails with .*: state.sum .* Got: 2 Expected: 1"),
        (("outputs", 0, "shape"), [2], r"it wrote action \[3, 1\] for 3 rows, not \[3, 2\]"),
        (("outputs", 0, "space"), None, "is damaged.*outputs.0.space"),
        (("guide", "place"), "elsewhere", "is damaged.*guide.place"),
        (("env",), "Sum", "is damaged.*env"),
    ],
)
def test_file_must_be_what_its_contract_says(place, value, message, tmp_path):
    with pytest.raises(UserError, match=message):
        ExportedPolicy(write(tmp_path, changed(place, value)))


def test_file_that_needs_more_memory_than_any_policy_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"it fails with .*ConstantOfShape"):
        ExportedPolicy(write(tmp_path, content=model(zeros=4_000_000_000)))


def lost(name):
    return lambda folder: (folder / name).unlink()


def replaced(content):
    """Return a change of a folder: another file, which its contract does not know."""
    return lambda folder: (folder / ONNX).write_bytes(content)


@pytest.mark.parametrize(
    ("content", "change", "message"),
    [
        (b"", lost(ONNX), f"{ONNX} does not exist"),
        (b"", lost(CONTRACT), f"{CONTRACT} does not exist"),
        (b"", replaced(model() + b"\0"), r"is not the file that .* is about: its SHA-256"),
        (b"no model", None, "no file that onnxruntime can read"),
        (model(batch=4), None, "it fails with .*: observation .* Got: 3 Expected: 4"),
        (model(seen="x"), None, r"it fails with Required inputs \(\['x'\]\) are missing"),
    ],
)
def test_file_that_takes_something_else_is_refused(content, change, message, tmp_path):
    write(tmp_path, content=content)
    if change is not None:
        change(tmp_path)
    with pytest.raises(UserError, match=message):
        ExportedPolicy(tmp_path / ONNX)


def test_missing_package_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr("coil_rl.extras.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"onnxruntime: .*pip install 'coil-rl\[export\]'"):
        ExportedPolicy(write(tmp_path))


def acts_in(**action):
    """Return a change of the contract: other numbers of the action, and no guide outside."""

    def change(contract):
        contract["guide"] = {"place": "inside", "names": ["sum"]}
        del contract["inputs"][1]
        contract["outputs"][0] |= action

    return change


OWN = {"bounds": {"low": [-1.0], "high": [1.0]}}
UPWARDS = {"bounds": {"low": [-1.0], "high": [None]}}
CHOICES = {"choices": [3], "lowest": [1], "shape": [1]}
SPACES = {
    "own": (Bounded(-1, 1, (1, 1)), None, OWN),
    "free": (Unbounded((1, 1)), None, {"bounds": None}),
    "upwards": (Bounded(torch.full((1, 1), -1.0), torch.full((1, 1), torch.inf)), None, UPWARDS),
    "from 1": (Categorical(3, (1,)), torch.tensor([1]), CHOICES),
    "from 0": (Categorical(3, (1,)), None, CHOICES | {"lowest": [0]}),
}


@pytest.mark.parametrize("name", SPACES)
def test_exported_guide_acts_in_its_own_action_only(name, tmp_path):
    guide = ExportedGuide(write(tmp_path, acts_in(**SPACES[name][2]), model(advised=False)))
    for other, (spec, first, _) in SPACES.items():
        space = ActionSpace(spec, 1, first)
        if other == name:
            guide.meet(space, {})
            continue
        with pytest.raises(UserError, match=r"is a policy for Sum, .*its action goes from"):
            guide.meet(space, {})
