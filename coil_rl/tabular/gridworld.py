"""A small world that can be looked at: cells, walls, a goal and pits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from coil_rl.tabular.mdp import MDP

MOVES = {"up": (-1, 0), "right": (0, 1), "down": (1, 0), "left": (0, -1)}
ARROWS = "↑→↓←"
PLAN = ("...G", ".#.X", "S...")


class Gridworld:
    """Walk from a start to a goal; the floor is slippery.

    Args:
        plan: rows of signs: `.` floor, `#` wall, `S` a start, `G` a goal, `X` a pit. Goals and pits end the episode.
        slip: probability to go to the left instead of ahead, and as much to go to the right. Who walks into a wall or
            off the plan stays.
        goal: reward for getting to a goal.
        pit: reward for falling into a pit.
        step: reward for each step besides.
        gamma: discount factor.

    Attributes:
        mdp: the world; its states are the cells row by row without the walls, its actions `MOVES`.
        cells: [S], row and column of each state.

    Raises:
        ValueError: for a plan or a probability that is none.

    Example:
        >>> from coil_rl.tabular import Gridworld, value_iteration
        >>> world = Gridworld()
        >>> print(world.draw(value_iteration(world.mdp).policy))
        →→→G
        ↑#↑X
        ↑←↑←
    """

    def __init__(
        self,
        plan: Sequence[str] = PLAN,
        *,
        slip: float = 0.1,
        goal: float = 1.0,
        pit: float = -1.0,
        step: float = -0.04,
        gamma: float = 0.95,
    ) -> None:
        if len({len(row) for row in plan}) != 1 or not set("".join(plan)) <= set(".#SGX") or "S" not in "".join(plan):
            raise ValueError(f"plan={list(plan)} must be rows of one length, of . # S G X, with at least one S")
        if not 0 <= slip <= 0.5:
            raise ValueError(f"slip={slip} must be between 0 and 0.5: it is the probability of each side")
        self.plan = tuple(plan)
        self.cells = [(y, x) for y, row in enumerate(plan) for x, sign in enumerate(row) if sign != "#"]
        place = {cell: state for state, cell in enumerate(self.cells)}
        signs = np.array([plan[y][x] for y, x in self.cells])
        ends = np.isin(signs, ["G", "X"])
        paid = step + goal * (signs == "G") + pit * (signs == "X")

        moves = list(MOVES.values())
        P = np.zeros((len(self.cells), len(moves), len(self.cells)))
        for s, (y, x) in enumerate(self.cells):
            for a in range(len(moves)):
                for turn, probability in {-1: slip, 0: 1 - 2 * slip, 1: slip}.items():
                    down, right = moves[(a + turn) % len(moves)]
                    P[s, a, s if ends[s] else place.get((y + down, x + right), s)] += probability
        R = np.where(ends[:, None, None], 0.0, paid)
        names = [f"row {y + 1}, column {x + 1}" for y, x in self.cells]
        start = (signs == "S") / (signs == "S").sum()
        self.mdp = MDP(P, np.broadcast_to(R, P.shape), gamma, start=start, states=names, actions=list(MOVES))

    def draw(self, policy: ArrayLike) -> str:
        """The plan with an arrow in each cell where there is something to choose; `policy` [S] are actions."""
        arrows = {cell: ARROWS[action] for cell, action in zip(self.cells, np.asarray(policy), strict=True)}
        return "\n".join(
            "".join(sign if sign in "#GX" else arrows[y, x] for x, sign in enumerate(row))
            for y, row in enumerate(self.plan)
        )
