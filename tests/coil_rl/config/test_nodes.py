"""Nodes are checked and built, and what they name of a user is told apart by file and state."""

import importlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal, Protocol

import gymnasium
import numpy as np
import pytest
import torch
from programs import composed
from torch import nn

from coil_rl.config.nodes import build, check_arguments, code_of_run, identity_of
from coil_rl.envs import Track
from coil_rl.errors import UserError


class NotRuntimeCheckable(Protocol):
    pass


@pytest.mark.parametrize(
    ("annotation", "good", "bad"),
    [
        (float, [1, 1.5, -2], ["1", None, True, float("nan"), float("inf"), 10**400, [1.0]]),
        (int, [1, -1, 2**63 - 1], [1.0, True, None, 2**63, "1"]),
        (bool, [True], [1, 0, "true", None]),
        (str, ["", "a"], [1, None, ["a"]]),
        (float | None, [None, 1], ["a"]),
        (Literal["a", 1], ["a", 1], ["b", None]),
        (Sequence[int], [[], [1, 2]], ["12", 1, [1, "a"], None]),
        (tuple[int, str], [[1, "a"]], [["a"], "a"]),
        (dict[str, float], [{}, {"a": 1}], [{"a": "b"}, [1], 1]),
        (Mapping, [{"a": "b"}], [[1]]),
        (float | Callable[[float], float], [1, {"_target_": "math.sqrt"}], ["sqrt"]),
        (
            Sequence[Track],
            [{"_target_": "coil_rl.envs.shipped_tracks"}, [{"_target_": "x"}]],
            [5, [1, 2], "abc"],
        ),
        (Any, [1, None, "a", []], []),
        (NotRuntimeCheckable, [1], []),
    ],
)
def test_value_is_checked_against_the_annotation(annotation, good, bad):
    def function(value):
        pass

    function.__annotations__["value"] = annotation
    function.__module__ = "coil_rl.part"
    for value in good:
        check_arguments(function, {"value": value}, "part")
    for value in bad:
        with pytest.raises(UserError, match=r"part\.value.*=.* must be "):
            check_arguments(function, {"value": value}, "part")


class Base:
    def __init__(
        self, needed: int, scale: float = 1.0, *, table: dict[str, float] | None = None, free=None
    ):
        pass


class Part(Base):
    def __init__(self, own: Sequence[int] | None = None, **options):
        super().__init__(**options)


Part.__module__ = "coil_rl.part"  # only classes of this project are known to pass their options on


@pytest.mark.parametrize(
    ("node", "program", "message"),
    [
        ({}, (), r"part: Part needs needed; give part\.needed=VALUE"),
        ({"needed": 1, "scal": 1}, (), "Part takes no scal; it takes own, .*; did you mean scale?"),
        ({"needed": 1}, ("needed",), "needed of Part is set by the program; leave it out"),
        ({"table": {"b": "x"}}, ("needed",), r"^part\.table\.b='x' must be a valid number$"),
        ({"own": [1, "x"]}, ("needed",), r"^part\.own\[1\]='x' must be a valid integer$"),
        ({"needed": 1, "_args_": [1]}, (), "Part takes no _args_"),
    ],
)
def test_wrong_arguments_are_refused(node, program, message):
    with pytest.raises(UserError, match=message):
        check_arguments(Part, node, "part", program)


def test_arguments_without_annotations_are_not_checked():
    check_arguments(Part, {"needed": 1, "free": object()}, "part")
    check_arguments(dict, {"anything": 1}, "part")


def wrapped(wrapper, arguments):
    """Return an env in a wrapper of Gymnasium, built from nodes."""
    node = {"_target_": f"gymnasium.wrappers.{wrapper}", "_partial_": True, **arguments}
    env = {"_target_": "coil_rl.GymnasiumEnv", "id": "Pendulum-v1", "wrappers": [node]}
    return build(env, "env")


@pytest.mark.parametrize(
    ("wrapper", "arguments", "shape"),
    [
        ("RescaleAction", {"min_action": [-1.0], "max_action": [1]}, [3]),
        ("RescaleObservation", {"min_obs": -1, "max_obs": 1}, [3]),
        ("ClipReward", {"min_reward": -1, "max_reward": 0}, [3]),
        ("FrameStackObservation", {"stack_size": 2, "padding_type": "zero"}, [2, 3]),
        ("ReshapeObservation", {"shape": [3, 1]}, [3, 1]),
        ("DtypeObservation", {"dtype": "float64"}, [3]),
        ("DiscretizeObservation", {"bins": [2, 2, 2]}, [8]),
        ("RepeatAction", {"num_repeats": 2}, [3]),
        (
            "StickyAction",
            {"repeat_action_probability": 0.5, "repeat_action_duration": [1, 3]},
            [3],
        ),
    ],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_wrappers_of_gymnasium_are_used_from_yaml(wrapper, arguments, shape):
    assert list(wrapped(wrapper, arguments).rollout(3)["observation"].shape[2:]) == shape


@pytest.mark.parametrize(
    ("wrapper", "arguments", "message"),
    [
        ("RescaleAction", {"min_action": -1, "max_acton": 1}, "takes no max_acton; .* max_action?"),
        ("RescaleAction", {"min_action": -1}, "cannot be made: .*missing.*'max_action'"),
        ("RescaleAction", {"min_action": "low", "max_action": 1}, r"min_action='low' must be "),
        ("ResizeObservation", {"shape": ["a", "b"]}, r"shape=\['a', 'b'\] must be"),
        ("ReshapeObservation", {"shape": [3, 2]}, "cannot be made: .*product of the new shape"),
        ("TimeLimit", {"max_episode_steps": True}, "max_episode_steps=true must be"),
        ("TransformReward", {"func": 3}, "func=3 must be callable"),
        ("RescaleObservatio", {}, "there is no 'gymnasium.wrappers.RescaleObservatio'"),
    ],
)
def test_wrapper_that_cannot_be_is_refused_in_one_sentence(wrapper, arguments, message):
    with pytest.raises(UserError, match=message):
        wrapped(wrapper, arguments)


class Thing:
    """An object with a state."""

    def __init__(self, **state):
        self.__dict__.update(state)

    def act(self, observation):
        return observation


class Gain(nn.Module):
    """A module with a number that is no weight."""

    def __init__(self, gain):
        super().__init__()
        self.gain = gain

    def forward(self, observation):
        return self.gain * observation


def linear(seed):
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(2, 1), nn.Tanh())


def scaled(gain):
    return lambda observation: gain * observation


def another(gain):
    return lambda observation: gain - observation


MAKERS = {
    "number": lambda n: Thing(gain=float(n)),
    "nested": lambda n: Thing(inner=[Thing(gains={"p": n})], names=("a", "b")),
    "array": lambda n: Thing(table=np.full(3, n)),
    "scalar": lambda n: Thing(gain=np.float32(n)),
    "tensor": lambda n: Thing(table=torch.full((), n, dtype=torch.bfloat16)),
    "set": lambda n: Thing(names={"a", "b", str(n)}),
    "closure": scaled,
    "partial": lambda n: partial(scaled, n),
    "method": lambda n: Thing(gain=n).act,
    "network": linear,
    "module": Gain,
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_objects_with_the_same_state_look_the_same_and_others_do_not(make):
    assert identity_of(make(1)) == identity_of(make(1))
    assert identity_of(make(1)) != identity_of(make(2))


def test_functions_differ_by_their_code():
    assert identity_of(scaled(1)) != identity_of(another(1))


CODE = """
import gymnasium
GAIN = {k}
class Base:
    def act(self, observation): return GAIN * observation
class Rule(Base): pass
def function(observation): return GAIN * observation
class Plant(gymnasium.Env):
    observation_space = action_space = gymnasium.spaces.Box(-1, 1, (1,))
gymnasium.register("Mine-v0", Plant)
"""


def imported(folder, monkeypatch, number):
    """Return a module of a user with a number in its file."""
    monkeypatch.syspath_prepend(folder)
    sys.modules.pop("mine", None)
    gymnasium.registry.pop("Mine-v0", None)
    shutil.rmtree(folder / "__pycache__", ignore_errors=True)
    (folder / "mine.py").write_text(CODE.format(k=number))
    importlib.invalidate_caches()
    return importlib.import_module("mine")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["function", "Base", "Rule"])
def test_code_of_a_user_is_told_apart_by_its_file_in_any_process(name, tmp_path, monkeypatch):
    # Each is taken while its file is there.
    takes = [lambda part: identity_of(part)]
    takes += [lambda part: identity_of(part())] if name != "function" else []
    for take in takes:
        one, same, other = (
            take(getattr(imported(tmp_path, monkeypatch, number), name)) for number in (1, 1, 2)
        )
        assert one == same != other
        assert one.startswith(f"mine.{name} (state ")
    call = f"import mine; from coil_rl.config.nodes import identity_of as i; print(i(mine.{name}))"
    printed = subprocess.run(
        [sys.executable, "-c", call],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        capture_output=True,
        text=True,
        check=True,
    )
    assert printed.stdout.strip() == identity_of(sys.modules["mine"].__dict__[name])
    sys.modules.pop("mine")


PLANT = "{_target_: mine.Plant, _partial_: true}"


@pytest.mark.fast(3)
@pytest.mark.parametrize(
    "words",
    [
        ["env.id=mine:Plant"],
        ["env.id=mine:Mine-v0"],
        ["env.id=Pendulum-v1", f"+env.controllers.mine={PLANT}"],
        ["env.id=Pendulum-v1", f"env.wrappers=[{PLANT}]"],
        ["env.id=Pendulum-v1", "guide=controller", "guide.controller.of=mine:Rule"],
        ["env.id=Pendulum-v1", "guide=controller", "guide.controller.of=mine:function"],
    ],
    ids=["class", "registered", "beside", "wrapper", "controller", "function"],
)
def test_code_of_a_run_is_that_of_the_files_which_its_parts_are_defined_in(
    words, tmp_path, monkeypatch, caplog
):
    config, found = composed("env=gym", "guide=constant", *words, "run_dir=unused"), []
    for number in (1, 1, 2):
        imported(tmp_path, monkeypatch, number)
        found.append(code_of_run(config))
    assert found[0] == found[1] != found[2]
    assert found[0].keys() == {"mine"}
    assert not caplog.records, "a registered name is no fault"
    sys.modules.pop("mine")


def test_network_is_the_same_after_it_was_used():
    network = linear(0)
    before = identity_of(network)
    network.eval()(torch.zeros(2))
    assert identity_of(network) == before


def test_object_that_holds_itself_has_a_state():
    one, other = Thing(gain=1), Thing(gain=1)
    one.own, other.own = [one], [other]
    assert identity_of(one) == identity_of(other) != identity_of(Thing(gain=1))


def test_object_whose_state_cannot_be_read_is_told_apart_by_its_file():
    class Odd:
        def __reduce_ex__(self, protocol):
            raise RuntimeError("no")

    assert identity_of(Odd()) == identity_of(Odd()) != identity_of(Thing())
