import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scipy import signal
from tensordict import TensorDict

from coil_rl import GymnasiumEnv, check_guide
from coil_rl.guides import PID
from coil_rl.guides.pid import MEMORY

DT, STEPS = 0.05, 200


class Loop:
    """A guide along an own plant: a row, or several."""

    def __init__(self, guide: PID, rows: int = 1) -> None:
        self.guide, self.first = guide, True
        zeros = torch.zeros(rows, guide.count, dtype=torch.float64)
        self.memory = {name: zeros for name in MEMORY}

    def __call__(self, **entries: Any) -> torch.Tensor:
        data = {
            name: torch.as_tensor(value, dtype=torch.float64) for name, value in entries.items()
        }
        rows = len(next(iter(data.values())))
        data["is_init"] = torch.full((rows, 1), self.first)
        after = self.guide(TensorDict({**data, **self.memory}, [rows]))
        self.first, self.memory = False, {name: after["next", name] for name in MEMORY}
        return after["action"]


def closed_loop(guide: PID) -> np.ndarray:
    """Return y of a plant 1 / (s^2 + 1.5 s + 1), held over each step, after a step of r to 1."""
    parts = map(np.array, ([[0, 1], [-1, -1.5]], [[0], [1]], [[1, 0]], [[0]]))
    a, b, c, *_ = signal.cont2discrete(tuple(parts), DT)
    loop, x, taken = Loop(guide), np.zeros((2, 1)), []
    for _ in range(STEPS):
        y = float((c @ x)[0, 0])
        taken.append(y)
        x = a @ x + b * loop(y=[[y]], r=[[1.0]]).item()
    return np.array(taken)


def reference(kp: float, ki: float, kd: float, filter: float, of_error: bool) -> np.ndarray:
    """Return the same by SciPy: the transfer function of the closed loop."""
    plant = signal.cont2discrete(([1.0], [1.0, 1.5, 1.0]), DT)
    num, den = np.atleast_1d(np.squeeze(plant[0])), plant[1]
    old = filter / (filter + DT)
    # kp + ki dt z / (z - 1), and kd (1 - a) / dt (z - 1) / (z - a), over one denominator.
    shared = np.polymul([1, -1], [1, -old])
    direct = np.polyadd(kp * shared, np.polymul([ki * DT, 0], [1, -old]))
    rate = kd * (1 - old) / DT * np.polymul([1, -1], [1, -1])
    over = np.polyadd(direct, rate)
    forward = over if of_error else direct
    top = np.polymul(num, forward)
    bottom = np.polyadd(np.polymul(den, shared), np.polymul(num, over))
    _, y = signal.dlsim((top, bottom, DT), np.ones(STEPS))
    return y[:, 0]


@pytest.mark.parametrize(
    "gains",
    [
        {"kp": 2.0},
        {"kp": 2.0, "ki": 1.5},
        {"kp": 4.0, "ki": 2.0, "kd": 0.8},
        {"kp": 4.0, "ki": 2.0, "kd": 0.8, "filter": 0.1},
        {"kp": -0.3, "ki": 0.4},
    ],
)
def test_step_response_is_that_of_scipy(gains: dict[str, float]) -> None:
    whole = {"kp": 1.0, "ki": 0.0, "kd": 0.0, "filter": 0.0} | gains
    y = closed_loop(PID("y", "r", step=DT, **gains))
    np.testing.assert_allclose(y, reference(**whole, of_error=False), rtol=0, atol=1e-6)


def test_derivative_of_the_error_differs_by_its_first_kick() -> None:
    # A loop begins at rest, so that the first error is no change; for SciPy it is a step from 0.
    gains = {"kp": 1.0, "ki": 0.0, "kd": 0.8, "filter": 0.1}
    guide = PID("y", "r", step=DT, derivative="error", **gains)
    loop = Loop(guide)
    assert loop(y=[[0.0]], r=[[0.0]]).item() == 0.0
    kick = loop(y=[[0.0]], r=[[1.0]]).item()
    assert kick == pytest.approx(1.0 + 0.8 / DT * DT / (0.1 + DT), abs=1e-6)
    held = Loop(PID("y", "r", step=DT, **gains))
    held(y=[[0.0]], r=[[0.0]])
    assert held(y=[[0.0]], r=[[1.0]]).item() == 1.0


def test_integral_does_not_wind_up() -> None:
    loop = Loop(PID("y", "r", kp=0.0, ki=1.0, step=1.0, low=-2.0, high=2.0))
    for _ in range(50):
        assert loop(y=[[0.0]], r=[[10.0]]).item() <= 2.0
    # It leaves the limit as soon as the error turns round.
    assert loop(y=[[11.0]], r=[[10.0]]).item() < 2.0


def test_feed_forward_and_bias_are_added() -> None:
    guide = PID("y", "r", kp=0.0, kf=2.0, feed="load", bias=-1.0)
    assert Loop(guide)(y=[[0.0]], r=[[5.0]], load=[[3.0]]).item() == 5.0
    assert Loop(PID("y", "r", kp=0.0, kf=0.5))(y=[[1.0]], r=[[5.0]]).item() == 2.5


def test_loops_are_a_list_in_each_argument() -> None:
    guide = PID(["a", ["b", 1]], ["r", 4.0], kp=[1.0, 10.0], ki=[0.0, 1.0], high=[math.inf, 5.0])
    entries = {"a": [[1.0], [2.0]], "b": [[9.0, 1.0], [9.0, 3.9]], "r": [[3.0], [3.0]]}
    action = Loop(guide, rows=2)(**entries)
    torch.testing.assert_close(action, torch.tensor([[2.0, 5.0], [1.0, 1.1]], dtype=torch.float64))


def test_pid_has_the_contract_of_a_guide_and_the_bounds_of_its_env() -> None:
    env = GymnasiumEnv("Pendulum-v1", num_envs=3)
    guide = PID(["observation", 1], kp=-100.0, ki=-1.0, kd=-1.0, filter=0.1, step=0.05)
    check_guide(guide, env)
    assert guide.numbers[5:].flatten().tolist() == [-2.0, 2.0]


def used(measured: Any, env: str = "Pendulum-v1") -> None:
    check_guide(PID(measured), GymnasiumEnv(env, num_envs=2))


@pytest.mark.parametrize(
    ("use", "sentence"),
    [
        (lambda: PID(["a", "b"], kp=[1.0, 2.0, 3.0]), "kp has 3 values.* 2 loops"),
        (lambda: PID([]), "measured names no entry"),
        (lambda: used("observation"), r"has 3 numbers; give .*\[observation,INDEX\]"),
        (lambda: used(["observation", 3]), r"\[observation,3\] must be one of 3 numbers"),
        (lambda: used(["observation", 1], "CartPole-v1"), "actions of this env are choices"),
        (lambda: used([["observation", 0], ["observation", 1]]), "1 numbers, but the PID 2 loops"),
    ],
)
def test_what_does_not_fit_is_refused(use: Callable[[], Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        use()


def test_it_knows_bounds_of_its_numbers() -> None:
    found = PID.tunable({"kp": 2.0, "ki": 0.0, "step": 0.1})
    assert found == {"kp": [0.1, 40.0, "log"], "ki": [0.02, 10.0, "log"]}
    found = PID.tunable({"kp": [-1.0, 1.0], "ki": [0.0, 5.0], "kd": [0.0, 0.1]})
    assert found["kp.0"] == [-20.0, -0.05]
    assert found["ki.0"] == [-0.5, -0.001]
    assert found["ki.1"] == [0.001, 100.0, "log"]
    assert "kd.0" not in found
    found = PID.tunable({"kp": [2.0], "ki": [0.0, 5.0], "step": 0.1})  # one gain for both loops
    assert found["ki.0"] == [0.02, 10.0, "log"]
    assert found["ki.1"] == [0.02, 100.0, "log"]
