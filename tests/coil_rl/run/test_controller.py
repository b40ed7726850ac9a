"""What a machine is sent is what an evaluation executes, for every method."""

from pathlib import Path

import numpy as np
import pytest
import torch
from outside_package.install import PROXY, SOURCE, TINY
from torchrl.envs import ExplorationType, set_exploration_type

import coil_rl
from coil_rl.run.parts import TEST

CONF = Path(__file__).parents[3] / "conf"
METHODS = sorted(file.stem for file in (CONF / "method").glob("*.yaml"))
STEPS = 30
# Methods that train their guides need a guide that fits the env for their proxies.
WITH_CHOICES = {"advisor"}


@pytest.fixture(autouse=True)
def package(monkeypatch):
    """Make the user's package importable, as one that is installed."""
    monkeypatch.syspath_prepend(SOURCE)


def executed(run):
    """Return observations of the plant and what it was given, in an episode of an evaluation."""
    env = run.make_env(1, TEST).eval()
    policy = run.policy(env)
    plant, observations, actions = env.base_env, [], []
    carrier = env.reset()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(STEPS):
            observations.append(plant.rows[0].observation)
            _, carrier = env.step_and_maybe_reset(policy(carrier))
            actions.append(plant._decode(plant.actions[-1])[0])
    return observations, actions


def trained(folder, method, *overrides):
    guide = None if method == "ppo" else "thermostat.control:PI"
    return coil_rl.train(
        "thermostat:Room-v0",
        guide=guide,
        method=method,
        folder=folder,
        overrides=[*TINY, *PROXY, f"proxy.folder={folder}/proxies_of_all", *overrides],
    )


@pytest.mark.parametrize("network", ["mlp", "gru"])
@pytest.mark.parametrize("method", METHODS)
def test_controller_acts_as_the_policy_does_in_an_evaluation(method, network, tmp_path):
    folder = tmp_path / "run"
    try:
        run = trained(folder, method, *([] if network == "mlp" else ["network=gru"]))
    except coil_rl.UserError as refusal:
        pytest.skip(str(refusal))
    observations, actions = executed(run)
    controller = coil_rl.open_run(folder).controller()
    for _ in range(2):
        controller.reset()
        sent = [controller.act(observation) for observation in observations]
        np.testing.assert_allclose(sent, actions, rtol=0, atol=1e-6)
    assert np.ptp(actions) > 1e-3
