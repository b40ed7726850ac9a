"""Finite Markov decision processes as arrays, and two examples: the toymaker and random worlds.

In all shapes S is the number of states and A the number of actions.
"""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from coil_rl.ranges import Interval, checked

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

BRANCHES = 3  # states to which an action of `garnet` can lead


@checked
class MDP:
    """A finite Markov decision process: transition probabilities, rewards and a discount factor.

    A state that every action leaves unchanged, with reward 0, is terminal: it ends an episode.
    Arrays that are no Markov decision process are a `ValueError` that names the entry.

    Args:
        P: [S, A, S], P[s, a, s'] the probability that action a leads from state s to state s'.
        R: [S, A, S], R[s, a, s'] the reward of that transition.
        gamma: discount factor, from 0 to less than 1.
        start: [S], start-state probabilities; uniform by default.
        states: the S names of the states, for tables and messages; numbers by default.
        actions: the A names of the actions; numbers by default.

    Attributes:
        r: [S, A], the expected reward of each action in each state.

    Example:
        >>> stay, change = ([[1, 0], [0, 1]], [[0, 1], [1, 0]])
        >>> P = [[stay[s], change[s]] for s in range(2)]
        >>> R = [[[0, 0], [5, 5]] for s in range(2)]
        >>> MDP(P, R, gamma=0.9, actions=("stay", "change")).r.tolist()
        [[0.0, 5.0], [0.0, 5.0]]
    """

    def __init__(
        self,
        P: ArrayLike,
        R: ArrayLike,
        gamma: Annotated[float, Interval(ge=0, lt=1)],
        *,
        start: ArrayLike | None = None,
        states: Sequence[str] | None = None,
        actions: Sequence[str] | None = None,
    ) -> None:
        self.P: Array = np.array(P, dtype=np.float64)
        self.R: Array = np.array(R, dtype=np.float64)
        if self.P.ndim != 3 or self.P.shape[0] != self.P.shape[2] or not self.P.size:
            raise ValueError(
                "P must have the shape [S, A, S], states by actions by states; "
                f"it has {self.P.shape}"
            )
        if self.R.shape != self.P.shape:
            raise ValueError(f"R must have the shape of P, {self.P.shape}; it has {self.R.shape}")
        self.gamma = gamma
        count, choices = self.P.shape[:2]
        self.states = _names("states", states, count)
        self.actions = _names("actions", actions, choices)
        self._check_entries()
        if start is None:
            self.start: Array = np.full(count, 1 / count)
        else:
            self.start = np.array(start, dtype=np.float64)
        if self.start.shape != (count,) or not _is_distribution(self.start):
            raise ValueError(
                f"start must be {count} probabilities, one a state, that sum to 1; got {self.start}"
            )
        self.r: Array = (self.P * self.R).sum(axis=2)

    def _check_entries(self) -> None:
        """Raise a `ValueError` for the first pair with invalid probabilities or rewards."""
        total = self.P.sum(axis=2)
        valid = np.isclose(total, 1, rtol=0, atol=1e-9) & (self.P >= 0).all(axis=2)
        for s, a in np.argwhere(~valid | ~np.isfinite(self.R).all(axis=2)):
            state, action = self.states[s], self.actions[a]
            if valid[s, a]:
                raise ValueError(
                    f"R[{s}, {a}]={self.R[s, a]} must be finite (state {state}, action {action})"
                )
            raise ValueError(
                f"P[{s}, {a}]={self.P[s, a]} must be probabilities that sum to 1 (state {state}, "
                f"action {action}); they sum to {total[s, a]:g}"
            )

    @property
    def terminal(self) -> NDArray[np.bool_]:
        """[S], whether each state is terminal."""
        stays = np.einsum("sas->sa", self.P) == 1
        return (stays & (self.r == 0)).all(axis=1)

    def q(self, V: Array) -> Array:
        """Return the value of each action, r + gamma P V, [S, A].

        Args:
            V: [S], the value of each state.
        """
        return self.r + self.gamma * self.P @ V

    def probabilities(self, policy: ArrayLike) -> Array:
        """Return the probabilities of the actions under a policy, [S, A].

        Args:
            policy: actions, [S] integers; or already their probabilities, [S, A].

        Raises:
            ValueError: if it is neither; the message names the first state that is wrong.
        """
        array = np.asarray(policy)
        count, choices = self.P.shape[:2]
        if array.shape == (count,) and array.dtype.kind in "iu":
            for s in range(count):
                if not 0 <= array[s] < choices:
                    raise ValueError(
                        f"policy[{s}]={array[s]} is no action in state {self.states[s]}; "
                        f"actions are 0 to {choices - 1}"
                    )
            return np.eye(choices)[array]
        if array.shape != (count, choices):
            raise ValueError(
                f"A policy is [{count}] integers, an action a state, or "
                f"[{count}, {choices}] probabilities; "
                f"got {array.dtype} of the shape {array.shape}"
            )
        for s in range(count):
            if not _is_distribution(array[s]):
                raise ValueError(
                    f"policy[{s}]={array[s]} must be probabilities that sum to 1, "
                    f"state {self.states[s]}"
                )
        return array.astype(np.float64)


def _is_distribution(probabilities: Array) -> bool:
    """Return whether numbers are not negative and sum to 1."""
    return not (probabilities < 0).any() and bool(np.isclose(probabilities.sum(), 1))


def _names(kind: str, names: Sequence[str] | None, count: int) -> tuple[str, ...]:
    if names is None:
        return tuple(map(str, range(count)))
    if len(names) != count:
        raise ValueError(f"{kind} has {len(names)} names, but P has {count} {kind}")
    return tuple(names)


def toymaker(gamma: float = 0.95) -> MDP:
    """Return Howard's toymaker (1960), the paper's first example, small enough to solve by hand.

    The toy is successful or not, and the toymaker advertises or not. Advertising costs reward now
    and makes a successful toy more likely; with a discount factor below 20/29, about 0.69, it does
    not pay.

    Args:
        gamma: the discount factor, from 0 to less than 1.
    """
    P = [[[0.5, 0.5], [0.8, 0.2]], [[0.4, 0.6], [0.7, 0.3]]]
    R = [[[9.0, 3.0], [4.0, 4.0]], [[3.0, -7.0], [1.0, -19.0]]]
    return MDP(
        P,
        R,
        gamma,
        states=("successful toy", "unsuccessful toy"),
        actions=("no advertising", "advertising"),
    )


def garnet(states: int, actions: int, rng: Generator, *, gamma: float = 0.9) -> MDP:
    """Return a random world (a Garnet, Archibald et al. 1995).

    Each action leads to three randomly drawn states, with probabilities from a flat Dirichlet
    distribution and a normally distributed reward that does not depend on the next state.

    Args:
        states: S, at least 3.
        gamma: the discount factor, from 0 to less than 1.
    """
    P = np.zeros((states, actions, states))
    for s, a in np.ndindex(states, actions):
        P[s, a, rng.choice(states, BRANCHES, replace=False)] = rng.dirichlet(np.ones(BRANCHES))
    R = np.broadcast_to(rng.normal(size=(states, actions, 1)), P.shape)
    return MDP(P, R, gamma)
