import csv
import shutil
import sys
from pathlib import Path

import gymnasium
import pytest
import torch
from hydra import compose, initialize_config_module

from coil_rl.config.assemble import load_guides
from coil_rl.config.check import check
from coil_rl.config.parts import disturbances, env_maker
from coil_rl.config.proxies import PROXIES, copy_proxies, frames_of, proxy_config
from coil_rl.config.python import Named, named, open_run
from coil_rl.config.python import composed as composed_in_python
from coil_rl.errors import UserError
from coil_rl.programs.distill import distill
from coil_rl.programs.train import train
from coil_rl.record import METRICS
from coil_rl.run.parts import TEST, TRAIN
from coil_rl.transforms import GuideActions, ObservationDelay

TINY = [
    "track=generated",
    "track.train.count=1",
    "track.test.count=1",
    "env.laps=1",
    "env.time_limit=1",
    "evaluation.curve.env.time_limit=1",
    "evaluation.repeats=1",
    "evaluation.gif=false",
    "logger=none",
    "budget.num_envs=4",
    "budget.steps=16",
    "budget.frames=128",
    "proxy.budget.frames=256",
    "proxy.budget.num_envs=4",
    "proxy.budget.steps=16",
    "proxy.learner.regressor.epochs=20",
]


def composed(*overrides, name="train"):
    tiny = TINY[:5] if name == "evaluate" else TINY
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        return compose(name, [*tiny, *overrides])


class Gain:
    """A controller with a state of its own."""

    def __init__(self, gain):
        self.gain = gain

    def act(self, observation):
        return [self.gain * observation[0]]


@pytest.fixture(scope="module")
def proxies(tmp_path_factory):
    folder = tmp_path_factory.mktemp("distill")
    config = composed(
        "guide=[spline,constant]",
        f"proxy.folder={folder / 'proxies'}",
        f"run_dir={folder}",
        name="distill",
    )
    distill(config)
    return folder / "proxies"


@pytest.mark.slow
def test_folder_of_a_proxy_follows_from_guide_env_and_settings():
    def folder(*overrides, guide="spline"):
        config = composed("guide=[spline,constant]", "run_dir=unused", *overrides)
        return Path(proxy_config(config, guide).run_dir)

    assert folder() == folder("seed=3", "method=ppo", "budget.frames=64", "run_dir=other")
    assert folder().parent == Path("outputs/proxies")
    others = [
        folder(other)
        for other in ("guide.spline.gain=0.9", "env.rate=20", "proxy.seed=1", "track.train.seed=5")
    ]
    assert len({folder(), folder(guide="constant"), *others}) == 6


@pytest.mark.slow
def test_proxy_is_trained_behind_the_delays_and_noise_of_the_run():
    def proxy(*overrides):
        config = composed("guide=spline", "run_dir=unused", *overrides)
        return proxy_config(config, "spline")

    words = ["disturb=[observation_delay]", "+evaluation.disturb.observation_delay.max_lag=7"]
    disturbed = proxy(*words)
    kinds = [type(part) for part in env_maker(disturbed)().transform]
    assert kinds.index(ObservationDelay) < kinds.index(GuideActions)
    lags = [
        disturbances(disturbed, cases)["observation_delay"]["max_lag"] for cases in (TRAIN, TEST)
    ]
    assert lags == [2, 7]
    others = [
        proxy(),
        proxy(words[0]),
        proxy(*words, "disturb.observation_delay.min_lag=1"),
        proxy(*words, "+training.disturb.observation_delay=null"),
    ]
    assert disturbed.run_dir == proxy(*words, "seed=3").run_dir
    assert len({disturbed.run_dir, *(other.run_dir for other in others)}) == 5


def folder_of_proxy(guide):
    given = named("Pendulum-v1", guide, "place")
    words = [*given.words, "method=dynamic_coil_sequential"]
    config = composed_in_python(Named(words, given.nodes), "unused")
    return proxy_config(config, "controller").run_dir


def test_proxies_of_other_objects_are_other_ones():
    one, other = (Gain(gain) for gain in (1.0, 2.0))
    assert folder_of_proxy(one) == folder_of_proxy(Gain(1.0)) != folder_of_proxy(other)


@pytest.mark.parametrize("code", ["class Mine:\n    def act(self, o):\n", "def Mine(o):\n"])
def test_proxy_of_a_controller_is_another_one_after_a_change_of_its_code(
    code, tmp_path, monkeypatch
):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    folders = []
    for gain in (1.0, 1.0, 2.0):
        (tmp_path / "changing.py").write_text(f"{code}        return [{gain} * o[0]]\n")
        monkeypatch.delitem(sys.modules, "changing", raising=False)
        folders.append(folder_of_proxy("changing:Mine"))
    assert folders[0] == folders[1] != folders[2]


PLANT = """
import gymnasium

class Plant(gymnasium.Env):
    observation_space = action_space = gymnasium.spaces.Box(-1, 1, (1,))
    gain = {gain}

gymnasium.register("Changing-v0", Plant)
"""


@pytest.mark.fast(2)
@pytest.mark.parametrize(
    "words",
    [
        ["env.id=changing:Plant"],
        ["env.id=changing:Changing-v0"],
        ["env.id=Pendulum-v1", "+env.controllers.mine={_target_: changing.Plant, _partial_: true}"],
        ["env.id=Pendulum-v1", "env.wrappers=[{_target_: changing.Plant, _partial_: true}]"],
    ],
    ids=["class", "registered", "controller", "wrapper"],
)
def test_proxy_in_an_env_is_another_one_after_a_change_of_its_code(words, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    folders = []
    for gain in (1.0, 1.0, 2.0):
        (tmp_path / "changing.py").write_text(PLANT.format(gain=gain))
        monkeypatch.delitem(sys.modules, "changing", raising=False)
        monkeypatch.delitem(gymnasium.registry, "Changing-v0", raising=False)
        with initialize_config_module("coil_rl.conf", version_base="1.3"):
            given = ["env=gym", *words, "guide=constant", "method=dynamic_coil_sequential"]
            config = compose("train", [*given, "run_dir=unused"])
        folders.append(proxy_config(config, "constant").run_dir)
    assert folders[0] == folders[1] != folders[2]


@pytest.mark.slow
def test_distilling_reports_the_error_of_the_network_and_reuses_it(proxies, capsys):
    folder = next(proxies.glob("constant_*"))
    with (folder / "metrics.csv").open(newline="") as file:
        *_, last = csv.DictReader(file)
    assert float(last["learner/mse_training"]) < 0.01
    assert float(last["learner/mse_ahead"]) < 0.01
    distill(
        composed(
            "guide=constant", f"proxy.folder={proxies}", f"run_dir={proxies.parent}", name="distill"
        )
    )
    output = capsys.readouterr().out
    assert str(folder) in output
    assert "distill: made 0, found 1; the lowest mean reward is" in output


@pytest.mark.slow
def test_proxy_that_was_killed_goes_on_to_the_same_weights(proxies, tmp_path, capsys):
    whole = next(proxies.glob("constant_*"))
    stopped = tmp_path / whole.name
    stopped.mkdir()
    for name in (
        "config.yaml",
        "versions.json",
        "guide_return.json",
    ):  # before the first checkpoint
        shutil.copy(whole / name, stopped)
    distill(
        composed(
            "guide=constant", f"proxy.folder={tmp_path}", f"run_dir={tmp_path}", name="distill"
        )
    )
    assert "distill: made 1, found 0;" in capsys.readouterr().out
    resumed = torch.load(stopped / "policy_last.pt", weights_only=True)
    for key, value in torch.load(whole / "policy_last.pt", weights_only=True).items():
        assert torch.equal(resumed[key], value), key


@pytest.mark.parametrize(("asked", "taken"), [(1, 64), (64, 64), (65, 128)])
def test_frames_of_a_proxy_are_whole_batches(asked, taken):
    words = ["guide=spline", "method=dynamic_coil_sequential", f"proxy.budget.frames={asked}"]
    proxy = proxy_config(composed(*words, "run_dir=unused"), "spline")
    assert frames_of(proxy.budget) == taken


@pytest.mark.slow
def test_run_trains_missing_proxies_and_copies_all_of_them(proxies, tmp_path):
    (tmp_path / "run").mkdir()
    overrides = [
        "method=dynamic_coil_sequential",
        "guide=[spline,zero]",
        f"proxy.folder={proxies}",
        "budget.frames=576",
        "learner.epochs=1",
        "learner.minibatches=2",
        f"run_dir={tmp_path / 'run'}",
    ]
    with pytest.raises(UserError, match="as the proxies of its guides take 512 frames"):
        check(composed(*overrides, "budget.frames=512"))
    config = composed(*overrides)
    check(config)
    train(config)
    assert sorted(path.name for path in (tmp_path / "run" / "proxies").iterdir()) == [
        "spline",
        "zero",
    ]
    assert len(list(proxies.glob("zero_*"))) == 1
    used = [next(proxies.glob(f"{name}_*")) / "metrics.csv" for name in ("spline", "zero")]
    taken = sum(METRICS.read(curve.parent)[-1]["frames"] for curve in used)
    assert METRICS.read(tmp_path / "run")[0]["frames/before"] == taken
    guides = load_guides(tmp_path / "run", config)
    network, state = (
        guides["spline"],
        torch.load(next(proxies.glob("spline_*")) / "policy_last.pt", weights_only=True),
    )
    assert all(torch.equal(value, state[key]) for key, value in network.state_dict().items())
    assert open_run(tmp_path / "run").policy()[0].names == ["spline", "zero"]


def test_degraded_advice_is_refused_for_guides_that_learn():
    config = composed("method=dynamic_coil_joint", "degrade=[noisy]", "run_dir=unused")
    with pytest.raises(
        UserError, match=r"degrade=\['noisy'\] has no effect on guides that are trained"
    ):
        check(config)


def test_proxies_are_copied_whole_or_not_at_all(tmp_path):
    run, folder = tmp_path / "run", tmp_path / "folder"
    for made in (run, folder):
        made.mkdir()
    (folder / PROXIES).write_text("a file in their place")
    with pytest.raises(
        UserError, match="proxies is a file, but a folder is to be made there; remove it"
    ):
        copy_proxies({"guide": run}, folder)
    (folder / PROXIES).unlink()
    with pytest.raises(FileNotFoundError):
        copy_proxies({"guide": run}, folder)
    assert not list(folder.iterdir())
