"""Loggers of runs that go on: shipped ones by name, with nothing but plain names of a folder."""

import pytest
import yaml
from programs import CONF

from coil_rl.config.trust import check_logger, make_logger, shipped_logger
from coil_rl.errors import UserError

SHIPPED = {path.stem: yaml.safe_load(path.read_text()) for path in (CONF / "logger").iterdir()}
NAMES = sorted(name for name, node in SHIPPED.items() if node)


@pytest.mark.parametrize("name", NAMES)
def test_shipped_logger_is_taken_by_its_class(name):
    assert shipped_logger({"_target_": SHIPPED[name]["_target_"]}) == SHIPPED[name]
    assert shipped_logger(SHIPPED[name]) == SHIPPED[name]


def test_five_loggers_are_shipped():
    assert NAMES == ["csv", "mlflow", "tensorboard", "trackio", "wandb"]


def test_plain_names_and_flags_of_a_folder_are_kept():
    changed = SHIPPED["wandb"] | {"project": "cones-2", "offline": False}
    assert shipped_logger(changed) == changed


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("wandb", "project", "../elsewhere"),
        ("wandb", "project", "${oc.env:HOME}"),
        ("wandb", "project", {"_target_": "os.system", "command": "ls"}),
        ("wandb", "project", 7),
        ("wandb", "offline", "false"),
        ("wandb", "save_dir", "elsewhere"),
        ("wandb", "base_url", "elsewhere"),
        ("wandb", "settings", {"_target_": "os.system"}),
        ("mlflow", "tracking_uri", "elsewhere"),
        ("mlflow", "artifact_location", "elsewhere"),
        ("csv", "log_dir", "elsewhere"),
        ("csv", "video_format", "mp4"),
        ("tensorboard", "log_dir", "/tmp/elsewhere"),
    ],
)
def test_nothing_else_of_a_folder_is_taken(name, key, value):
    assert shipped_logger(SHIPPED[name] | {key: value}) == SHIPPED[name]


@pytest.mark.parametrize(
    "node",
    [
        None,
        "wandb",
        [],
        {},
        {"_target_": None},
        {"_target_": ["os.system"]},
        {"_target_": "os.system"},
        {"_target_": "torchrl.record.loggers.get_logger"},
    ],
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
