"""Controllers for three tasks of Gymnasium's MuJoCo (extra mujoco).

They read the observation that Gymnasium's pages describe, and advise torques or forces [n] in the
units of the env.
"""

import numpy as np
from numpy.typing import NDArray

LINKS = 0.1, 0.11  # m, of Reacher-v5


class Reach:
    """Drives the arm of Reacher-v5 to its target by the inverse of its Jacobian, with damping.

    Args:
        gain: torque per rad.
        damping: torque per rad/s.
    """

    def __init__(self, gain: float = 0.1, damping: float = 0.05) -> None:
        self.gain, self.damping = gain, damping

    def act(self, observation: NDArray) -> NDArray:
        """Return the torques [2] for cosines [2], sines [2], target [2], speeds [2], error [2]."""
        first, second = np.arctan2(observation[2:4], observation[:2])
        near, far = LINKS
        tip = far * np.array([-np.sin(first + second), np.cos(first + second)])
        elbow = near * np.array([-np.sin(first), np.cos(first)])
        jacobian = np.stack([elbow + tip, tip], 1)
        square = jacobian.T @ jacobian + 1e-4 * np.eye(2)  # regular where the arm is straight
        way = np.linalg.solve(square, -jacobian.T @ observation[8:10])
        return (self.gain * way - self.damping * observation[6:8]).clip(-1.0, 1.0)


class AngleFeedback:
    """Balances the pole of InvertedPendulum-v5 by its angle and rate, without regard to the cart.

    So the cart leaves the rail after about 230 of 1000 steps.

    Args:
        gain: N per rad.
        damping: N per rad/s.
    """

    def __init__(self, gain: float = 5.0, damping: float = 0.5) -> None:
        self.gain, self.damping = gain, damping

    def act(self, observation: NDArray) -> NDArray:
        """Return the force [1] for the position, the angle and their speeds."""
        _, angle, _, rate = observation
        return np.array([self.gain * angle + self.damping * rate]).clip(-3.0, 3.0)


class StateFeedback:
    """Balances the two poles of InvertedDoublePendulum-v5 by a linear-quadratic regulator.

    Args:
        gains: of the position, the sines of both angles, and their speeds. The defaults solve the
            Riccati equation of the linearised env with weights 1, 10, 10, 0.1, 0.1, 0.1 and 1 of
            the force.
    """

    def __init__(
        self, gains: tuple[float, ...] = (-0.21, -1.81, -5.57, -0.31, -0.9, -0.85)
    ) -> None:
        self.gains = np.array(gains)

    def act(self, observation: NDArray) -> NDArray:
        """Return the force [1] for the position, sines [2], cosines [2], speeds [3] and a rest."""
        state = observation[[0, 1, 2, 5, 6, 7]]
        return np.array([self.gains @ state]).clip(-1.0, 1.0)
