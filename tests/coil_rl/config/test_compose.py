"""What a person wrote in a file, or on the command line, is what runs, or is refused."""

import math
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from package_entries import declare
from programs import CONF, ROOT, called, environment, shipped
from tensordict import NestedKey

from coil_rl import Measure, UserError
from coil_rl.config import python
from coil_rl.config.compose import compose_train, covers, default_learner
from coil_rl.measures import measures_of
from coil_rl.transforms.action_space import nested_key, written_key

METHODS = shipped("method")
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
def test_every_value_of_a_users_part_survives_the_composition(group, tmp_path):
    shipped, node = OWN[group]
    own = OmegaConf.to_container(OmegaConf.load(CONF / group / f"{shipped}.yaml"), resolve=False)
    own.pop("defaults", None)
    values = {key: changed(value) for key, value in leaves(own)}
    content = OmegaConf.create({})
    for key, value in values.items():
        OmegaConf.update(content, key, value, force_add=True)
    file = tmp_path / group / "mine.yaml"
    file.parent.mkdir()
    file.write_text(f"# @package {node}\n{OmegaConf.to_yaml(content)}")
    word = {"degrade": "degrade=[mine]", "measures": "+measures=mine"}.get(group, f"{group}=mine")
    words = ["env=gym", "method=coil", *([] if group == "guide" else ["guide=zero"]), word]
    written = {f"{node}.{key}": value for key, value in values.items()}
    assert kept(composed(tmp_path, *words), written) == []


def test_users_part_may_list_the_file_that_it_changes(tmp_path):
    (tmp_path / "learner").mkdir()
    text = "# @package learner\ndefaults: [ppo, _self_]\ngamma: 0.5\n"
    (tmp_path / "learner" / "mine.yaml").write_text(text)
    learner = composed(tmp_path, "env=gym", "guide=zero", "method=coil", "learner=mine")["learner"]
    assert (learner["_target_"], learner["gamma"]) == ("coil_rl.learners.PPO", 0.5)
    assert "defaults" not in learner


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


PENDULUM = ["env=gym", "env.id=Pendulum-v1"]
SAC = ["learner=sac", "budget.frames=100000"]


@pytest.mark.fast(4)
@pytest.mark.parametrize(
    ("words", "found"),
    [
        (PENDULUM, SAC),
        ([*PENDULUM, "guide=random", "budget.frames=64"], ["learner=sac", "learner.starts=16"]),
        (["env=gym", "env.id=CartPole-v1"], []),
        ([*PENDULUM, "learner=a2c"], []),
        ([*PENDULUM, "method=coil_anchored", "learner.gamma=0.9"], SAC),
        ([*PENDULUM, "seed=0,1"], SAC),
        (["env=torchrl", "env.of._target_=torchrl.envs.PendulumEnv"], SAC),
        ([*PENDULUM, "budget.frames=2_000"], SAC[:1]),
        ([*PENDULUM, "budget.frames=1e3"], []),
        ([*PENDULUM, "budget.frames=${evaluation.cases}"], ["learner=sac", "learner.starts=5"]),
        ([*PENDULUM, "method=ppo"], []),
        ([*PENDULUM, "network=gru"], []),
        ([*PENDULUM, "init=earlier"], []),
        (["env=gym", "env.id=Pendulum-v1,CartPole-v1"], []),
        (["env=gym", "env.id=Nothing-v0"], []),
        (["env=gym"], []),
        (["env=pendulum"], []),
        ([], []),
    ],
)
def test_actions_that_are_numbers_are_learned_by_sac(words: list[str], found: list[str]) -> None:
    assert default_learner(words) == found


@pytest.mark.parametrize(
    "key",
    ["zone/2.speed", "1", "T_in [°C]", 'the "inner" one', ("observation", "0"), ("Höhe", "a b")],
)
def test_a_key_in_a_message_may_be_typed_as_it_is(key: NestedKey) -> None:
    word = OverridesParser.create().parse_override(f"observes=[{written_key(key)}]")
    assert [nested_key(each) for each in word.value()] == [key]


def test_options_may_follow_the_words_to_which_the_learner_is_added() -> None:
    shown = called("train", *PENDULUM, "--cfg", "job").stdout
    assert "_target_: coil_rl.learners.SAC" in shown


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "label"), [("Pendulum-v1", "sac"), ("CartPole-v1", "ppo"), ("pendulum", "ppo")]
)
def test_a_run_in_python_has_the_learner_of_the_command(tmp_path, env: str, label: str) -> None:
    run = python.prepare(env, folder=tmp_path, frames=640)
    assert run.label == label
    assert (f"learner={label}" in run.command) == (label == "sac")


def measures_with(*words: str) -> dict[str, Measure]:
    return measures_of(compose_train(["env=pendulum", "method=ppo", *words]).evaluation.measures)


ADDED = "evaluation.measures.last."


@pytest.mark.parametrize(
    "added",
    [
        [f"{ADDED}entry=reward", f"{ADDED}reduction=last"],
        [f"+{ADDED}entry=reward", f"+{ADDED}reduction=last"],
        ["evaluation.measures.last={entry: reward, reduction: last}"],
    ],
)
def test_a_measure_is_added_on_the_command_line_beside_those_of_the_env(added: list[str]) -> None:
    measures = measures_with(*added)
    assert set(measures) == {"completed", "last"}
    assert measures["last"] == Measure("reward", "last")


@pytest.mark.parametrize("name", ["reward", "case", "lap_episodes"])
def test_a_measure_named_as_another_column_is_refused(name: str) -> None:
    with pytest.raises(UserError, match=f"{name} is already a column of the tables"):
        measures_with(f"evaluation.measures.{name}.entry=reward")


def test_values_of_a_measure_have_their_types() -> None:
    with pytest.raises(UserError, match=r"measures\.low: could not convert .* 'much'"):
        measures_with("evaluation.measures.low={entry: reward, at_least: much}")


SCRIPT = """
import coil_rl.config
from hydra import compose, initialize_config_dir
from coil_rl import compose_train
from coil_rl.config.trust import _shipped_targets

config = compose_train(["guide=wise", "run_dir=unused"])
assert config.guide.wise._target_ == "stranger.Wise", config.guide
assert "stranger.Wise" in _shipped_targets()
with initialize_config_dir("FOLDER", version_base="1.3"):
    # Where the group does not exist this is a value, and no choice of a file.
    assert dict(compose("own", ["+guide=wise"])) == {"a": 1, "guide": "wise"}
"""


@pytest.mark.slow
def test_files_of_an_installed_package_are_found_and_only_by_programs_of_coil_rl(tmp_path):
    package = tmp_path / "stranger" / "conf"
    (package / "guide").mkdir(parents=True)
    for folder in (package.parent, package):
        (folder / "__init__.py").write_text("")
    (package / "guide" / "wise.yaml").write_text("# @package guide.wise\n_target_: stranger.Wise\n")
    declare(tmp_path, "stranger", "1", "coil_rl.conf", {"stranger": "stranger.conf"})
    (tmp_path / "own.yaml").write_text("a: 1\n")
    command = [sys.executable, "-c", SCRIPT.replace("FOLDER", str(tmp_path))]
    done = subprocess.run(
        command, cwd=ROOT, env=environment(tmp_path), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


GLOBALLY = "# @package _global_\n"
FILES = {
    "method/a": (
        f"{GLOBALLY}method: {{observes: []}}",
        "method.name must be given: write method.name=VALUE",
    ),
    "method/b": ("method: {name: b, observes: []}", "method/b.yaml: Hydra puts its keys under"),
    "method/c": (
        f"{GLOBALLY}method: {{name: c, transform: {{}}}}",
        "method/c.yaml: method has no key transform; it has name, observes, transforms, ",
    ),
    "method/d": (
        f"{GLOBALLY}method: {{name: d}}",
        "method.observes must be given: write method.observes=VALUE",
    ),
    "method/f": (
        f"{GLOBALLY}defaults: [ppo]\nlearner: {{anchr: null}}",
        "method/f.yaml: learner: PPO takes no anchr; it takes ",
    ),
    "experiment/e": (
        "defaults: [override /env: pendulum]",
        "experiment/e.yaml: begin the file with the line # @package _global_",
    ),
}


@pytest.mark.fast(2)
@pytest.mark.parametrize("file", FILES)
def test_mistake_in_a_file_of_the_user_names_the_file(file, tmp_path):
    text, said = FILES[file]
    group, name = file.split("/")
    (tmp_path / group).mkdir()
    (tmp_path / group / f"{name}.yaml").write_text(text)
    chosen = f"+{group}={name}" if group == "experiment" else f"{group}={name}"
    done = called("train", "--config-dir", str(tmp_path), chosen, cwd=tmp_path, code=2)
    assert done.stderr.startswith("train: ")
    assert said in done.stderr


UNKNOWN = "guide/mine.yaml: guide.mine: ClassicGuide takes no foo; it takes "


OF_A_BOUND = f"tune: a bound is no value of .*: {UNKNOWN}"


@pytest.mark.parametrize(
    ("words", "said"),
    [([], UNKNOWN), (["method=tune", "tune={weights.0: [0, 1]}"], OF_A_BOUND)],
    ids=["driving", "tuned"],
)
def test_file_of_an_unknown_argument_is_named_in_python(words, said, tmp_path):
    (tmp_path / "guide").mkdir()
    text = (CONF / "guide" / "linear_feedback.yaml").read_text()
    text = text.replace("guide.linear_feedback", "guide.mine", 1) + "foo: 1\n"
    (tmp_path / "guide" / "mine.yaml").write_text(text)
    words = [f"hydra.searchpath=[file://{tmp_path}]", *words]
    with pytest.raises(UserError, match=f"^{said}"):
        python.prepare("cart_pole", guide="mine", folder=tmp_path / "run", overrides=words)


def test_key_of_a_swept_file_says_how_to_write_it(tmp_path):
    words = ["-m", "env=pendulum,cart_pole", "env.workers=0", "seed=0,1"]
    done = called("train", *words, cwd=tmp_path, code=2)
    assert "write env.workers=choice(VALUE)" in done.stderr
