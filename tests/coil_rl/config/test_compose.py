"""What a person wrote in a file, or on the command line, is what runs, or is refused."""

import math
from itertools import pairwise
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from programs import CONF, called, shipped

from coil_rl import compose_train
from coil_rl.config.compose import covers

METHODS = shipped("method")
FAST = ("coil", "dagger", "rlpd")
# Groups whose files may set everything, and a shipped file to begin with.
GLOBAL = {"env": "gym", "method": None, "experiment": None}
# Groups whose files set their own node only: a shipped file, and the node.
OWN = {
    "guide": ("zero", "guide.mine"),
    "degrade": ("noisy", "degrade.mine"),
    "action": ("choices", "action"),
    "network": ("mlp", "learner.network"),
    "learner": ("ppo", "learner"),
    "measures": ("driving", "evaluation.measures"),
}
UNKEPT = ("env.id", "run_dir", "label", "method.name", "resume", "existing", "trust", "init")


def leaves(node, name=""):
    """Yield full key and value of everything that is no mapping."""
    if not isinstance(node, dict) or not node:
        yield name, node
        return
    for key, value in node.items():
        yield from leaves(value, f"{name}.{key}" if name else str(key))


def changed(value):
    """Return another value of the same kind."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, float)):
        return value + 1 if math.isfinite(value) else value
    return value


def write(folder, group, values, shipped=None):
    """Write a file of a user that may set everything, and return the word that chooses it."""
    defaults = ["_self_"] if shipped is None else [shipped, "_self_"]
    if shipped == "gym":
        defaults.insert(1, {"override /guide": "zero"})
    file = Path(folder / group / "mine.yaml")
    file.parent.mkdir(parents=True, exist_ok=True)
    text = OmegaConf.to_yaml(OmegaConf.create({"defaults": defaults, **values}))
    file.write_text(f"# @package _global_\n{text}")
    return "+experiment=mine" if group == "experiment" else f"{group}=mine"


def composed(folder, *words):
    search = f"hydra.searchpath=[file://{folder}]"
    config = compose_train([search, "env.id=CartPole-v1", "run_dir=unused", *words])
    return OmegaConf.to_container(config, resolve=False)


def kept(result, written):
    """Return the values of a file that are not in a configuration."""
    found = dict(leaves(result))
    return [key for key, value in written.items() if found.get(key) != value]


@pytest.mark.slow
@pytest.mark.parametrize("group", GLOBAL)
@pytest.mark.parametrize("method", METHODS)
def test_every_value_of_a_users_file_survives_the_composition(group, method, tmp_path):
    base = composed(tmp_path, "env=gym", "guide=zero", f"method={method}")
    written, values = {}, OmegaConf.create({})
    for key, value in leaves(base):
        new = changed(value)
        if not key.endswith("_target_") and key not in UNKEPT and new != value:
            written[key] = new
            OmegaConf.update(values, key, new, force_add=True)
    shipped = method if group == "method" else GLOBAL[group]
    word = write(tmp_path, group, OmegaConf.to_container(values), shipped)
    words = [word] if group == "method" else [word, f"method={method}"]
    words += [] if group == "env" else ["env=gym"]
    result = composed(tmp_path, *words, "guide=zero")
    assert len(written) > 20
    assert kept(result, written) == []


@pytest.mark.fast(2)
@pytest.mark.parametrize("group", OWN)
@pytest.mark.parametrize("method", FAST)
def test_every_value_of_a_users_part_survives_the_composition(group, method, tmp_path):
    shipped, node = OWN[group]
    source = OmegaConf.load(CONF / group / f"{shipped}.yaml")
    own = OmegaConf.to_container(source, resolve=False)
    own.pop("defaults", None)
    values = {key: changed(value) for key, value in leaves(own)}
    file = tmp_path / group / "mine.yaml"
    file.parent.mkdir()
    content = OmegaConf.create({})
    for key, value in values.items():
        OmegaConf.update(content, key, value, force_add=True)
    file.write_text(f"# @package {node}\n{OmegaConf.to_yaml(content)}")
    word = {"degrade": "degrade=[mine]", "measures": "+measures=mine"}.get(group, f"{group}=mine")
    if group == "learner" and method in ("dagger", "rlpd"):
        pytest.skip("the method chooses its learner")
    words = ["env=gym", f"method={method}", *([] if group == "guide" else ["guide=zero"]), word]
    written = {f"{node}.{key}": value for key, value in values.items()}
    assert kept(composed(tmp_path, *words), written) == []


def test_command_line_is_stronger_than_a_file(tmp_path):
    write(tmp_path, "env", {"learner": {"gamma": 0.5, "clip": 0.1}}, "gym")
    config = composed(tmp_path, "env=mine", "method=coil", "guide=zero", "learner.gamma=0.7")
    assert (config["learner"]["gamma"], config["learner"]["clip"]) == (0.7, 0.1)


@pytest.mark.parametrize("between", [(), ("between",)], ids=["listed", "listed by a listed one"])
def test_file_overrides_the_files_that_its_defaults_list_leads_to(between, tmp_path):
    folder = tmp_path / "experiment"
    folder.mkdir()
    names = ["base", *between, "mine"]
    (folder / "base.yaml").write_text("# @package _global_\nbudget: {frames: 3_000, steps: 5}\n")
    for listed, name in pairwise(names):
        frames = "budget: {frames: 2_000}\n" if name == "mine" else ""
        text = f"# @package _global_\ndefaults: [{listed}, _self_]\n{frames}"
        (folder / f"{name}.yaml").write_text(text)
    config = composed(tmp_path, "env=gym", "+experiment=mine")
    assert (config["budget"]["frames"], config["budget"]["steps"]) == (2_000, 5)


@pytest.mark.slow
def test_value_that_a_learner_does_not_take_is_refused_by_its_name(tmp_path):
    write(tmp_path, "env", {"learner": {"gae_lambda": 0.5}}, "gym")
    arguments = ["--config-dir", str(tmp_path), "env=mine", "env.id=Pendulum-v1", "method=coil"]
    refused = called("train", *arguments, "guide=zero", "learner=sac", cwd=tmp_path, code=2).stderr
    assert "SAC takes no gae_lambda" in refused


@pytest.mark.parametrize(
    ("one", "other", "is_covered"),
    [
        ("env.id", "env.id", True),
        ("env", "env.options.gravity", True),
        ("env.options.gravity", "env", True),
        ("env.id", "env.ids", False),
        ("env.ids", "env.id", False),
        ("env.id", "env.rate", False),
    ],
)
def test_one_of_two_keys_is_the_other_or_inside_it(one, other, is_covered):
    assert covers(one, other) == is_covered
