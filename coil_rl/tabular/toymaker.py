"""The toymaker (Howard 1960): the paper's first example, small enough to be solved by hand."""

from __future__ import annotations

from coil_rl.tabular.mdp import MDP


def toymaker(gamma: float = 0.95) -> MDP:
    """A toymaker whose toy is successful or not, and who can advertise it, or not.

    Advertising costs something now and makes a successful toy more likely, which pays later.

    Args:
        gamma: discount factor; below 20/29, about 0.69, advertising does not pay.
    """
    nothing, advertising = 0, 1
    P = [[[0.0, 0.0]] * 2 for _ in range(2)]
    R = [[[0.0, 0.0]] * 2 for _ in range(2)]
    P[0][nothing], R[0][nothing] = [0.5, 0.5], [9.0, 3.0]
    P[1][nothing], R[1][nothing] = [0.4, 0.6], [3.0, -7.0]
    P[0][advertising], R[0][advertising] = [0.8, 0.2], [4.0, 4.0]
    P[1][advertising], R[1][advertising] = [0.7, 0.3], [1.0, -19.0]
    return MDP(P, R, gamma, states=("successful toy", "unsuccessful toy"), actions=("no advertising", "advertising"))
