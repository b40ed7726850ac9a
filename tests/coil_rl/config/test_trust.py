"""What a received run folder may name, and the logger that it may have."""

import copy
import importlib.resources
import json
import sys
from functools import partial
from itertools import zip_longest

import hydra.utils
import pytest
import yaml
from omegaconf import OmegaConf
from package_entries import declare
from programs import CONF, composed, shipped

from coil_rl.config import assemble as assembling
from coil_rl.config import nodes, trust
from coil_rl.config.assemble import make_logger
from coil_rl.config.check import check_logger
from coil_rl.config.folder import read_config, settings
from coil_rl.config.parts import proxy_config
from coil_rl.config.python import open_run
from coil_rl.config.schema import TrainConfig
from coil_rl.config.trust import shipped_logger
from coil_rl.errors import UserError
from coil_rl.programs import train
from coil_rl.run import folder as run_folder
from coil_rl.run.folder import write_config

CODE = """
    os.system os.popen os.execv posix.system subprocess.run subprocess.Popen subprocess.check_output
    builtins.eval builtins.exec builtins.open builtins.__import__ builtins.getattr joblib.load
    torch.load torch.save torch.compile torch.hub.load torch.utils.collect_env.run
    torch.utils.cpp_extension.load_inline numpy.load numpy.save
    numpy.distutils.exec_command.exec_command distutils.spawn.spawn sympy.sympify shutil.copyfile
    shutil.rmtree pickle.loads marshal.loads importlib.import_module runpy.run_path pydoc.locate
    hydra.utils.call hydra.utils.get_method hydra.utils.instantiate timeit.timeit code.interact
    pty.spawn webbrowser.open ctypes.CDLL pathlib.Path.write_text functools.partial
    operator.methodcaller antigravity.this pandas.read_pickle omegaconf.OmegaConf.save
    tensordict.load sklearn.utils.fixes.os.system torchrl.envs.GymEnv cloudpickle.loads
    coil_rl.programs.app.os.system coil_rl.programs.app.shutil.rmtree coil_rl.files.write_text
    coil_rl.envs.save_track coil_rl.envs.save_drive coil_rl.envs.RecordingWriter
    coil_rl.config.assemble.run_configured coil_rl.config.trust.trust_packages
    coil_rl.guides.SplineGuide.__init__ coil_rl.guides.spline.math.sqrt сoil_rl.guides.SplineGuide
    torchrl.record.loggers.WandbLogger
""".split()  # noqa: SIM905


SHIPPED = {path.stem: yaml.safe_load(path.read_text()) for path in (CONF / "logger").iterdir()}
NAMES = sorted(name for name, node in SHIPPED.items() if node)


@pytest.fixture(autouse=True)
def forget():
    yield
    trust.trust_packages([])


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Return the configuration of a run as coil-train saves it."""
    folder = tmp_path_factory.mktemp("saved") / "run"
    config = begun(folder)
    # The first reading of a process imports what the others need.
    trust._shipped_targets()
    read_config(folder, "run")
    return config


def begun(folder, *overrides):
    config = composed(*overrides, f"run_dir={folder}")
    folder.mkdir()
    write_config(folder, settings(config))
    return OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))


def changed(saved, key, value):
    config = copy.deepcopy(saved)
    *parents, last = key.split(".")
    node = config
    for name in parents:
        node[name] = node[name] if isinstance(node.get(name), dict) else {}
        node = node[name]
    node[last] = value
    return config


def read(folder, content):
    if not isinstance(content, str):
        content = json.dumps(content)  # JSON is YAML
    (folder / "config.yaml").write_text(content)
    return read_config(folder, "run", goes_on=True)


def no_import(name, *_):
    raise AssertionError(f"{name} was imported")


PATHS = ["os:system", "posix:system", "os.system", "builtins:eval", "coil_rl.files:os.system"]
NAMING_CODE = [
    *(("method.transforms.x._target_", target) for target in CODE),
    *((key, path) for key in ("guide.theirs.of", "env.of") for path in PATHS),
]


@pytest.mark.fast(10)
@pytest.mark.parametrize(("key", "name"), NAMING_CODE)
def test_name_outside_the_list_is_refused_before_any_import(
    key, name, saved, tmp_path, monkeypatch
):
    modules = set(sys.modules)
    monkeypatch.setattr(hydra.utils, "get_object", no_import)
    monkeypatch.setattr(importlib, "import_module", no_import)
    with pytest.raises(UserError, match="could run code") as error:
        read(tmp_path, changed(saved, key, name))
    named = f"{tmp_path / 'config.yaml'}: {key} names {name.replace(':', '.')!r}"
    assert named in str(error.value)
    assert set(sys.modules) == modules


def test_gymnasium_env_of_a_module_is_refused_like_the_module(package, saved, tmp_path):
    theirs = changed(saved, "env.id", "their_package:Env-v0")
    with pytest.raises(UserError, match=r"trust=\[their_package\]"):
        read(tmp_path, theirs)
    assert "their_package" not in sys.modules
    trust.trust_packages(["their_package"])
    assert read(tmp_path, theirs).env.id == "their_package:Env-v0"
    with pytest.raises(UserError, match="no part of a run"):
        read(tmp_path, changed(saved, "env.id", "os:x-v0"))
    assert read(tmp_path, changed(saved, "env.id", "LunarLander-v3")).env.id == "LunarLander-v3"


KEYS = ["guide.spline", "env.reward", "track.test.deep.er", "logger", "watch.step.x"]
KEYS += ["proxy.method.x", "preset.perception", "budget.x", "unknown.key", "label"]


@pytest.mark.fast(2)
@pytest.mark.parametrize("key", KEYS)
def test_target_is_refused_wherever_it_is(key, saved, tmp_path):
    for value in ({"_target_": "os.system"}, [[1, {"deep": [{"_target_": "os.system"}]}]]):
        with pytest.raises(UserError, match=r"_target_ names 'os\.system', which is no part of a"):
            read(tmp_path, changed(saved, key, value))


@pytest.mark.fast(6)
@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("env.x", {"_target_": ["os.system"]}, "which is not the full name of a class"),
        ("env.x", {"_target_": {"_target_": "os.system"}}, "which is not the full name of a"),
        ("env.x", {"_target_": "${label}"}, "which is not the full name of a class"),
        ("env.x", {"_target_": None}, "names None, which is not the full name of a class"),
        ("env.x", {"_target_": "my_package.Part"}, r'or trust=\["my_package"\] in Python$'),
        ("env.x", {"_target_": "coil_rl.guides.SplinGuide"}, "mean coil_rl.guides.SplineGuide"),
        ("env.x", {"_args_": ["x"]}, "_args_ is not a key of a run's configuration"),
        ("env.x", {"_recursive_": False}, "_recursive_ is not a key"),
        ("env.x", {"_convert_": "none"}, "_convert_ is not a key"),
        ("env.x", "${oc.env:HOME}", "is a reference; put the value in its place"),
        ("env.x", "${label}", "is a reference"),
        ("logger", {"x": "${oc.env:HOME}"}, "is a reference"),
        ("logger", {"x": "${logger.exp_name}"}, "is a reference"),
        ("logger", {"x": "a ${${label}}"}, "is a reference"),
        ("env.x", {"_target_": "torchrl.record.loggers.CSVLogger"}, "could run code"),
        ("guide", {"../../x": {}}, "must not contain / or"),
        ("label", "../../x", "label must not contain / or"),
    ],
)
def test_trick_is_refused(key, value, message, saved, tmp_path):
    with pytest.raises(UserError, match=message):
        read(tmp_path, changed(saved, key, value))


def test_run_with_a_logger_of_its_own_is_evaluated_without_it(saved, tmp_path):
    theirs = changed(saved, "logger", {"_target_": "os.system", "command": "ls"})
    with pytest.raises(UserError, match="could run code"):
        read(tmp_path, theirs)
    assert read_config(tmp_path, "run").logger is None


def test_shipped_logger_writes_only_where_it_is_shipped_to_write(saved, tmp_path):
    theirs = changed(saved, "logger.log_dir", "/tmp/elsewhere")
    assert read(tmp_path, theirs).logger == OmegaConf.create(SHIPPED["tensorboard"])


NINEFOLD = [f"a{n + 1}: &a{n + 1} [{', '.join([f'*a{n}'] * 9)}]" for n in range(30)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: &a [1, 1]\nb: *a\n", r"repeats a part of itself by \*a"),
        ("\n".join(["a0: &a0 [x]", *NINEFOLD]), "repeats"),
        ("a: &a\n  b: *a\n", "repeats a part of itself"),
        ("a: " + "[" * 5000 + "]" * 5000, "has more than 32 levels"),
        ("a: " + "x" * 200_000, r"is not the configuration of a run \(it has more than 200,000"),
        ("a: !!python/object/apply:os.system [ls]\n", "is not the configuration of a run"),
        ("label: " + "9" * 5000, "is not the configuration of a run"),
    ],
    ids=["alias", "alias bomb", "cycle", "deep", "large", "tag", "digits"],
)
def test_file_that_no_run_writes_is_refused(text, message, tmp_path):
    with pytest.raises(UserError, match=message) as error:
        read(tmp_path, text)
    assert str(tmp_path / "config.yaml") in str(error.value)


# Of the cone world.
GROUPS = ("guide", "degrade", "learner", "logger", "method", "track", "action", "preset")
MISSING = [
    "+track.dir=levels",
    "+guide.learned.run=other",
    "+guide.exported.file=a",
    "+guide.pid.measured=observation",
    "+guide.controller.of=coil_rl.guides:SplineGuide",
    "+guide.recorded.file=a.csv",
    "+guide.entry.key=steering",
]
OF_ENV = {
    "fmu": ["env.file=motor.fmu"],
    "gym": ["env.id=CartPole-v1"],
    "torchrl": ["env.of._target_=coil_rl.envs.ConeTrackEnv"],
}


@pytest.mark.slow
def test_every_choice_of_the_configuration_can_be_saved_and_read(tmp_path, monkeypatch):
    monkeypatch.setattr(run_folder, "versions", dict)
    monkeypatch.setattr(trust, "_packages", frozenset({"coil_fmu"}))  # an FMU is a program
    columns = [[f"{group}={name}" for name in shipped(group)] for group in GROUPS]
    choices = [[*filter(None, row), *MISSING] for row in zip_longest(*columns)]
    choices += [[f"env={name}", *OF_ENV.get(name, [])] for name in shipped("env")]
    for number, overrides in enumerate(choices):
        begun(tmp_path / str(number), *overrides)
        assert read_config(tmp_path / str(number), "run").label


def test_configuration_of_a_proxy_can_be_read(saved, tmp_path):
    proxy = proxy_config(OmegaConf.merge(OmegaConf.structured(TrainConfig), saved), "spline")
    proxy.run_dir = "anywhere"
    write_config(tmp_path, settings(proxy))
    assert read_config(tmp_path, "run").label == "proxy of spline"


def test_named_parts_exist_and_are_classes():
    parts = trust.NAMED - {nodes.TARGET}
    wrong = [name for name in parts if not isinstance(hydra.utils.get_object(name), type)]
    assert wrong == []


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Make a package that could be installed, and return its folder."""
    folder = tmp_path / "site"
    (folder / "their_package").mkdir(parents=True)
    source = "import os\nfrom coil_rl.guides import ZeroGuide\n\n"
    source += "class TheirGuide(ZeroGuide):\n    pass\n"
    (folder / "their_package" / "__init__.py").write_text(source)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "their_package", raising=False)  # of another test
    yield folder
    sys.modules.pop("their_package", None)


def with_target(saved, target, **others):
    return changed(saved | others, "guide.theirs", {"_target_": target})


def with_controller(saved, path):
    theirs = {"_target_": "coil_rl.guides.ControllerGuide", "of": path}
    return changed(saved, "guide.theirs", theirs)


@pytest.mark.parametrize(("naming", "sep"), [(with_target, "."), (with_controller, ":")])
def test_trusted_package_may_be_used_and_nothing_that_it_imports(
    naming, sep, package, saved, tmp_path
):
    theirs = naming(saved, f"their_package{sep}TheirGuide")
    with pytest.raises(UserError, match=r"allow it with trust=\[their_package\]"):
        read(tmp_path, theirs)
    assert "their_package" not in sys.modules
    trust.trust_packages(["their_package"])
    assert read(tmp_path, theirs).guide.theirs
    for name in ("os.system", "ZeroGuide", "TheirGuide.__init__.__globals__"):
        with pytest.raises(UserError, match="which is defined elsewhere"):
            read(tmp_path, naming(saved, f"their_package{sep}{name}"))
    with pytest.raises(UserError, match="which their_package does not have"):
        read(tmp_path, naming(saved, f"their_package{sep}Missing"))
    with pytest.raises(UserError, match="which could run code"):
        read(tmp_path, naming(saved, f"their_package2{sep}TheirGuide"))
    trust.trust_packages([])
    with pytest.raises(UserError, match=r"trust=\[their_package\]"):
        read(tmp_path, theirs)


def test_objects_of_a_trusted_package_may_be_used_if_it_made_them(package, saved, tmp_path):
    source = """
from functools import partial
from torch.nn import Linear
from numpy import r_ as rows  # an object of NumPy, under another name
from torch import ops  # a module, whose load_library runs any code
from sklearn.linear_model import LinearRegression

def steer(observation, gain): ...

quick, network, forest = partial(steer, gain=2), Linear(2, 1), LinearRegression()
"""
    (package / "their_package" / "objects.py").write_text(source)
    trust.trust_packages(["their_package"])
    for name in ("quick", "network", "forest.predict"):
        assert read(tmp_path, with_controller(saved, f"their_package.objects:{name}"))
    for name in (
        *("rows", "ops", "ops.load_library", "Linear", "partial", "LinearRegression.predict"),
        *("forest.fit", "quick.func.__globals__", "network.weight"),
    ):
        with pytest.raises(UserError, match="which is defined elsewhere"):
            read(tmp_path, with_controller(saved, f"their_package.objects:{name}"))


@pytest.mark.parametrize(("naming", "sep"), [(with_target, "."), (with_controller, ":")])
def test_what_the_command_itself_names_is_trusted_in_folders(naming, sep, package, saved, tmp_path):
    theirs = naming(saved, f"their_package{sep}TheirGuide")
    trust.trust_own(OmegaConf.create({"guide": theirs["guide"]}))
    assert read(tmp_path, theirs).guide.theirs
    with pytest.raises(UserError, match=r"trust=\[their_package\]"):
        read(tmp_path, naming(saved, f"their_package{sep}Other"))


def test_folder_cannot_grant_itself_trust_and_a_run_does_not_save_it(package, saved, tmp_path):
    with pytest.raises(UserError, match=r"allow it with trust=\[their_package\]"):
        read(tmp_path, with_target(saved, "their_package.TheirGuide", trust=["their_package"]))
    assert "trust" not in begun(tmp_path / "run", "trust=[their_package]")


def test_installed_package_with_an_entry_point_is_trusted(package, saved, tmp_path):
    trusted = {"their_package": "their_package", "os": "os"}
    declare(package, "their_package", "1.0", "coil_rl.trusted", trusted)
    assert read(tmp_path, with_target(saved, "their_package.TheirGuide")).guide.theirs
    with pytest.raises(UserError, match="which is no part of a run"):
        read(tmp_path, with_target(saved, "os.system"))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        *((name, rf"functions of {name} run any code") for name in ("os", "builtins", "torch")),
        *((name, rf"functions of {name} run any code") for name in ("hydra", "coil_rl")),
        ("a.b", r"trust=\[a.b\] must be a list of names of installed"),
    ],
)
def test_package_that_cannot_be_trusted_is_refused(name, message):
    with pytest.raises(UserError, match=message):
        trust.trust_packages([name])


@pytest.mark.slow
def test_resumed_run_writes_only_into_its_own_folder(saved, tmp_path, monkeypatch):
    folder = tmp_path / "run"
    folder.mkdir()
    outside = {"run_dir": str(tmp_path / "outside"), "proxy.folder": str(tmp_path / "outside")}
    config = OmegaConf.create(saved)
    for key, value in outside.items():
        OmegaConf.update(config, key, value)
    OmegaConf.save(config, folder / "config.yaml")
    resumed, assemble = [], assembling.assemble

    def remembered(config):
        resumed.append(config)
        run = assemble(config)
        run.finish_begun = lambda changed: 0.0
        return run

    monkeypatch.setattr(assembling, "assemble", remembered)
    train.resume(folder)
    (config,) = resumed
    assert config.run_dir == config.logger.log_dir == str(folder)
    assert config.proxy.folder == str(folder / "distilled")
    (folder / "latest.log").symlink_to("config.yaml")
    train.resume(folder)
    (folder / "metrics.csv").symlink_to(tmp_path / "outside.csv")
    opened = open_run(folder)
    assert opened.settings["run_dir"] == str(folder)
    for go_on in (opened.train, partial(train.resume, folder)):
        with pytest.raises(UserError, match=r"metrics\.csv is a link out of the folder"):
            go_on()


@pytest.mark.parametrize(
    ("name", "changes", "taken"),
    [
        *((name, {}, {}) for name in NAMES),
        ("wandb", {"project": "cones-2"}, {"project": "cones-2"}),
        ("wandb", {"offline": False}, {"offline": False}),
        ("wandb", {"project": "../elsewhere"}, {}),
        ("wandb", {"project": "${oc.env:HOME}"}, {}),
        ("wandb", {"project": {"_target_": "os.system", "command": "ls"}}, {}),
        ("wandb", {"project": 7}, {}),
        ("wandb", {"offline": "false"}, {}),
        ("wandb", {"save_dir": "elsewhere"}, {}),
        ("wandb", {"base_url": "elsewhere"}, {}),
        ("wandb", {"settings": {"_target_": "os.system"}}, {}),
        ("mlflow", {"tracking_uri": "elsewhere"}, {}),
        ("mlflow", {"artifact_location": "elsewhere"}, {}),
        ("csv", {"log_dir": "elsewhere"}, {}),
        ("csv", {"video_format": "mp4"}, {}),
        ("tensorboard", {"log_dir": "/tmp/elsewhere"}, {}),
    ],
)
def test_plain_names_and_flags_of_a_shipped_logger_are_taken_and_nothing_else(name, changes, taken):
    for given in (SHIPPED[name], {"_target_": SHIPPED[name]["_target_"]}):
        assert shipped_logger(given | changes) == SHIPPED[name] | taken


@pytest.mark.parametrize(
    "node",
    [None, "wandb", {}, {"_target_": None}, {"_target_": ["os.system"]}, {"_target_": "os.system"}],
)
def test_what_is_not_shipped_is_none_of_them(node):
    assert shipped_logger(node) is None


@pytest.mark.parametrize("name", ["tensorboard", "wandb", "mlflow", "trackio"])
def test_missing_package_is_named_with_the_extra_that_installs_it(name, monkeypatch):
    monkeypatch.setattr("coil_rl.extras.find_spec", lambda package: None)
    with pytest.raises(UserError, match=rf"needs {name}: .* 'coil-rl\[{name}\]'"):
        check_logger(SHIPPED[name])
    check_logger(SHIPPED["csv"])


def broken(**arguments):
    raise RuntimeError("api_key not\nconfigured")


def test_logger_that_cannot_be_started_is_one_sentence():
    with pytest.raises(UserError, match=r"could not be started \(api_key not configured\);"):
        make_logger({"_target_": f"{__name__}.broken"})
