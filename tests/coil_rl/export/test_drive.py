"""The driver that ships with an exported policy: short, without this package, and right."""

import ast
import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from exported_sums import write
from torchrl.envs import ExplorationType, set_exploration_type

import coil_rl
from coil_rl.config.assemble import assemble
from coil_rl.config.folder import folder_of, read_config
from coil_rl.export import ExportedPolicy, drive, export_policy
from coil_rl.run.parts import TEST

SOURCE = Path(drive.__file__)
LONGEST = 25  # statements besides imports


def test_driver_is_short_and_needs_no_other_package():
    tree = ast.parse(SOURCE.read_text())
    imported = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            imported.add(node.module)
    others = {name for name in imported if name not in sys.stdlib_module_names}
    assert others == {"numpy", "onnxruntime"}
    left_out = (ast.Expr, ast.Import, ast.ImportFrom)  # docstrings and imports
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.stmt)]
    assert sum(not isinstance(node, left_out) for node in nodes) <= LONGEST


def copied(folder):
    """Return the module of the driver that lies in a folder."""
    spec = importlib.util.spec_from_file_location("copied", folder / SOURCE.name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_input_that_is_missing_is_named(tmp_path):
    shutil.copy(SOURCE, write(tmp_path) / SOURCE.name)
    policy = copied(tmp_path).Policy()
    with pytest.raises(ValueError, match=r"guide_action must be \[1\] finite numbers"):
        policy.act({"observation": [1.0, 2.0]})
    assert policy.act({"observation": [2.0, 3.0], "guide_action": [10.0]}) == 16.0


def test_contract_is_read_in_any_locale(tmp_path):
    def degrees(contract):
        contract["outputs"][0]["unit"] = "°"

    shutil.copy(SOURCE, write(tmp_path, degrees) / SOURCE.name)
    done = subprocess.run(
        [sys.executable, "-X", "utf8=0", "-c", "import drive; drive.Policy()"],
        cwd=tmp_path,
        env=os.environ | {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("wrong", [[0], [5], [2.5]])
def test_advice_that_is_no_choice_is_refused(wrong, tmp_path):
    def choices(contract):
        contract["inputs"][-1] |= {"choices": [3], "lowest": [2]}

    shutil.copy(SOURCE, write(tmp_path, choices) / SOURCE.name)
    driver, policy = copied(tmp_path).Policy(), ExportedPolicy(tmp_path)
    assert driver.act({"observation": [2.0, 3.0], "guide_action": [4.0]}) == 10.0
    with pytest.raises(ValueError, match=r"numbers of choices, \[3\] from \[2\] on"):
        driver.act({"observation": [2.0, 3.0], "guide_action": wrong})
    with pytest.raises(ValueError, match=r"no choices of \[3\] from \[2\] on"):
        policy.act([2.0, 3.0], wrong)


@pytest.mark.parametrize(
    ("dtype", "wrong"),
    [("float32", 1e300), ("float32", 1j), ("uint8", 300), ("uint8", -5), ("uint8", 0.5)],
)
def test_number_that_the_dtype_does_not_hold_is_refused(dtype, wrong, tmp_path):
    def typed(contract):
        contract["inputs"][0]["dtype"] = dtype

    shutil.copy(SOURCE, write(tmp_path, typed) / SOURCE.name)
    driver, policy = copied(tmp_path).Policy(), ExportedPolicy(write(tmp_path / "float32"))
    typed(policy.contract)
    with pytest.raises(ValueError, match=rf"observation must be \[2\] finite numbers of {dtype}"):
        driver.act({"observation": np.array([1, wrong]), "guide_action": [4.0]})
    with pytest.raises(ValueError, match=rf"observation is .*, but must be .* numbers of {dtype}"):
        policy.act(np.array([1, wrong]), [4.0])


def driven(env, act, most):
    """Return the sum of the rewards of one row, and its number of steps."""
    carrier, total = env.reset(), 0.0
    for step in range(1, most + 1):
        action = torch.as_tensor(act(carrier), dtype=torch.float32).reshape(1, 1)
        after = env.step(carrier.set("action", action))
        total += float(after["next", "reward"])
        if after["next", "done"].any():
            return total, step
        carrier = env.step_mdp(after)
    raise AssertionError(f"the lap did not end within {most} steps")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["coil", "ppo"])
def test_lap_driven_by_the_file_alone_has_the_reward_of_torch(name, tmp_path):
    folder = folder_of(f"cone_track/{name}")
    config = read_config(folder, "run")
    config.env.laps = 1
    run = assemble(config)
    export_policy(run, tmp_path, observations=300)
    policy, controller = copied(tmp_path).Policy(), run.controller()
    read = [entry["name"] for entry in policy.contract["inputs"]]

    def by_file(carrier):
        return policy.act({key: carrier[key][0].numpy() for key in read})

    def by_torch(carrier):
        keys = controller.plant.observation_spec.keys()
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return controller.act_on(carrier.select(*keys).clone())

    rewards = [
        driven(run.make_env.bare(1, TEST, None), act, most=1_000) for act in (by_file, by_torch)
    ]
    assert rewards[0][1] == rewards[1][1]
    assert rewards[0][0] == pytest.approx(rewards[1][0], abs=0.01)
    exported = ExportedPolicy(tmp_path)
    exported.reset()
    policy.reset()
    carrier = run.make_env.bare(1, TEST, None).reset()
    own = exported.act({key: carrier[key][0].numpy() for key in read})
    np.testing.assert_array_equal(own, by_file(carrier))
    inputs = {key: carrier[key][0].numpy() for key in read}
    for wrong in (inputs[read[0]][None], np.full_like(inputs[read[0]], np.nan)):
        with pytest.raises(ValueError, match="finite numbers"):
            policy.act(inputs | {read[0]: wrong})


@pytest.mark.slow
def test_driver_runs_where_this_package_is_not(tmp_path):
    export_policy(coil_rl.pretrained("pendulum/coil"), tmp_path, observations=50)
    code = (
        "import sys; sys.modules['torch'] = sys.modules['coil_rl'] = None; import drive; "
        "print(drive.Policy().act({'observation': [1.0, 0.0, 0.5]}).shape)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "(1,)"
