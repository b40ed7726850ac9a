import csv
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_module

from coil_rl.errors import UserError
from coil_rl.programs import evaluate
from coil_rl.programs.distill import distill
from coil_rl.programs.train import train
from coil_rl.train import distillation, load
from coil_rl.train.check import check

TINY = ["track=generated", "track.train.count=1", "track.test.count=1", "env.laps=1", "env.time_limit=1",
        "evaluation.repeats=1", "evaluation.gif=false", "logger=none", "budget.cars=4", "budget.steps=16",
        "budget.frames=128", "proxy.budget.frames=256", "proxy.budget.cars=4", "proxy.budget.steps=16",
        "proxy.learner.regressor.epochs=20"]  # fmt: skip


def composed(*overrides, name="train"):
    tiny = TINY[:5] if name == "evaluate" else TINY
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        return compose(name, [*tiny, *overrides])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    config = composed(
        "guide=[spline,constant]", f"proxy.folder={folder / 'proxies'}", f"run_dir={folder}", name="distill"
    )
    distill(config)
    return folder / "proxies"


def test_a_proxy_is_found_by_what_it_was_made_from():
    def folder(*overrides, guide="spline"):
        config = composed("guide=[spline,constant]", "run_dir=unused", *overrides)
        return Path(distillation.configuration(config, guide).run_dir)

    assert folder() == folder("seed=3") == folder("method=ppo") == folder("budget.frames=64") == folder("run_dir=other")
    assert folder().parent == Path("outputs/proxies")
    others = [folder(other) for other in ("guide.spline.gain=0.9", "env.rate=20", "proxy.seed=1", "track.train.seed=5")]
    assert len({folder(), folder(guide="constant"), *others}) == 6


def test_distilling_says_how_well_the_network_does_what_the_guide_would(made, capsys):
    folder = next(made.glob("constant_*"))
    with (folder / "metrics.csv").open(newline="") as file:
        *_, last = csv.DictReader(file)
    assert float(last["learner/mse_training"]) < 0.01
    assert float(last["learner/mse_ahead"]) < 0.01
    distill(composed("guide=constant", f"proxy.folder={made}", f"run_dir={made.parent}", name="distill"))
    said = capsys.readouterr().out
    assert str(folder) in said  # found, not made again
    assert "distill: made 1; the lowest mean reward is" in said


def test_a_run_makes_the_proxies_that_it_misses_and_keeps_its_own(made, tmp_path):
    (tmp_path / "run").mkdir()
    words = ["method=dynamic_coil_sequential", "guide=[spline,zero]", f"proxy.folder={made}", "budget.frames=64",
             f"run_dir={tmp_path / 'run'}"]  # fmt: skip
    config = composed(*words)
    check(config)
    train(config)
    assert sorted(path.name for path in (tmp_path / "run" / "proxies").iterdir()) == ["spline", "zero"]
    assert len(list(made.glob("zero_*"))) == 1
    kept = load.load_guides(tmp_path / "run", config)
    network, state = kept["spline"], torch.load(next(made.glob("spline_*")) / "policy_last.pt", weights_only=True)
    assert all(torch.equal(value, state[key]) for key, value in network.state_dict().items())
    asked = composed(f"run={tmp_path / 'run'}", f"run_dir={tmp_path}", name="evaluate")
    _, policy = evaluate.restore(tmp_path / "run", asked)
    assert policy[0].names == ["spline", "zero"]


def test_advice_that_is_degraded_does_not_go_with_guides_that_learn():
    config = composed("method=dynamic_coil_joint", "degrade=[noisy]", "run_dir=unused")
    with pytest.raises(UserError, match=r"degrade=\['noisy'\] has no effect on guides that are trained"):
        check(config)
