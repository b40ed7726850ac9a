"""Training and evaluation on a GPU, where there is one."""

import shutil

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_module
from programs import program, read_csv
from tiny_runs import METHODS, PPO, TRACKS, trained

from coil_rl.programs.evaluate import evaluate
from coil_rl.programs.train import resume

DEVICE = "cuda"
if not torch.cuda.is_available():
    pytest.skip("needs a CUDA device", allow_module_level=True)


def rewards(folder, *, sampled=True):
    """Return the rewards of the table, or those of deterministic actions."""
    rows = [
        row for row in read_csv(folder / "evaluation.csv") if sampled or row["actions"] != "sampled"
    ]
    return np.array([float(row["reward"]) for row in rows])


@pytest.mark.parametrize("method", METHODS)
def test_method_is_trained_and_evaluated(method, tmp_path):
    proxies = f"proxy.folder={tmp_path / 'proxies'}"
    run = trained(tmp_path / "run", method, f"device={DEVICE}", proxies)
    assert len(rewards(run))
    assert np.isfinite(rewards(run)).all()


@pytest.mark.parametrize(
    "settings",
    [
        ["network=gru"],
        ["action=choices"],
        ["degrade=[adversarial]"],
        ["disturb=[observation_delay,action_delay,observation_noise]"],
        ["beside=fallback"],
        ["delivery=tested", "training.tests.time_limit=0.5"],
        ["training.normalise=true", "training.scale_rewards=true"],
        ["training.noise_correlation=0.7"],
    ],
    ids=lambda settings: settings[0],
)
def test_option_is_trained_and_evaluated(settings, tmp_path):
    run = trained(tmp_path / "run", "coil", f"device={DEVICE}", *settings)
    assert np.isfinite(rewards(run)).all()


SHORT = [*PPO, "budget.num_envs=4", "budget.steps=16", "budget.frames=128", "logger=none"]
SHORT += ["evaluation.repeats=1", "evaluation.gif=false", "evaluation.curve.points=1"]


@pytest.mark.parametrize(
    "settings",
    [
        ["env=pendulum"],
        ["env=pendulum", "env.workers=2"],
        ["env=cart_pole"],
        ["env=simulated_robot", "env.laps=1", "env.time_limit=1"],
        ["env=driving_tasks"],
    ],
    ids=lambda settings: "-".join(settings[:2]),
)
def test_env_that_steps_beside_the_gpu_is_trained_and_evaluated(settings, tmp_path):
    folder = f"hydra.run.dir={tmp_path / 'run'}"
    program("train", "method=coil", f"device={DEVICE}", *settings, *SHORT, folder, cwd=tmp_path)
    assert np.isfinite(rewards(tmp_path / "run")).all()


def test_resumed_run_has_the_same_weights(tmp_path):
    run = trained(tmp_path / "run", "coil", f"device={DEVICE}")
    stopped = shutil.copytree(run, tmp_path / "stopped")
    for name in ("evaluation.csv", "policy_last.pt", "checkpoint.pt"):
        (stopped / name).unlink()
    resume(stopped)
    first, again = (
        torch.load(folder / "policy_last.pt", map_location="cpu", weights_only=True)
        for folder in (run, stopped)
    )
    assert all(torch.equal(value, again[key]) for key, value in first.items())


def test_policy_acts_on_the_cpu_as_on_the_gpu(tmp_path):
    run = trained(tmp_path / "run", "coil", f"device={DEVICE}")
    for device in ("cpu", DEVICE):
        settings = [f"run={run}", f"run_dir={tmp_path / device}", f"device={device}", *TRACKS]
        settings += ["env.time_limit=2", "evaluation.repeats=1", "evaluation.gif=false"]
        with initialize_config_module("coil_rl.conf", version_base="1.3"):
            evaluate(compose("evaluate", settings))
    on_cpu, on_gpu = (rewards(tmp_path / device, sampled=False) for device in ("cpu", DEVICE))
    assert np.allclose(on_cpu, on_gpu, atol=0.1)


def test_comparison_ends_with_its_sentences(tmp_path):
    settings = ["env=pendulum", f"device={DEVICE}", "minutes=0.2", "folder=run"]
    assert "coil-train env=pendulum" in program("compare", *settings, cwd=tmp_path).stdout
