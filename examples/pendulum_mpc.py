"""A predictive controller of your own as a guide: CasADi plans the torque of Gymnasium's pendulum.

    python -m pip install casadi
    export PYTHONPATH=examples
    coil-compare env=pendulum guide=controller guide.controller.of=pendulum_mpc:MPC

A plan costs milliseconds, so `coil-compare` times it first and says what everything will take; each
row of the env has an object of its own, in as many processes as `env.workers` says.
"""

import casadi as ca
import numpy as np

STEP, HORIZON = 0.05, 20  # s, steps


class MPC:
    """Plans `HORIZON` steps ahead with the pendulum's own equations, and takes the first one.

    Args:
        effort: price of a squared torque.
    """

    def __init__(self, effort: float = 0.001) -> None:
        plan = self.plan = ca.Opti()
        self.start, self.torque = plan.parameter(2), plan.variable(HORIZON)
        angle, speed, cost = self.start[0], self.start[1], 0
        for torque in ca.vertsplit(self.torque):
            speed += STEP * (15 * ca.sin(angle) + 3 * torque)
            angle += STEP * speed
            # 1 - cos is the squared angle near the top, and has no jump at the bottom.
            cost += 2 * (1 - ca.cos(angle)) + 0.1 * speed**2 + effort * torque**2
        plan.minimize(cost)
        plan.subject_to(plan.bounded(-2, self.torque, 2))
        quiet = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 30}}
        plan.solver("ipopt", quiet)
        self.reset()

    def reset(self) -> None:
        """Begin an episode: the first plan starts from nothing."""
        self.last = np.full(HORIZON, 0.1)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the torque, [1], for cos, sin and speed of the angle, which is 0 at the top."""
        cos, sin, speed = map(float, observation)
        self.plan.set_value(self.start, [np.arctan2(sin, cos), speed])
        self.plan.set_initial(self.torque, self.last)
        try:
            found = self.plan.solve().value(self.torque)
        except RuntimeError:  # it stopped before it was done: its last values are good enough
            found = self.plan.debug.value(self.torque)
        self.last = np.append(found[1:], found[-1])  # the next plan starts from this one
        return np.clip(found[:1], -2, 2)
