"""Q-learning: optimal control of a Markov decision process that is not known, only lived through (equation 52).

After each step, Q(s, a) <- Q(s, a) + alpha (r + gamma max Q(s', .) - Q(s, a)). Q comes to the optimal one if each
action is taken in each state again and again, and the step sizes alpha of each pair add up to infinity while their
squares do not (theorem 2.3). The first is what epsilon is for, the second is what `power` is for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from coil_rl.tabular.mdp import MDP, Array, Integers
from coil_rl.tabular.simulator import Simulator


@dataclass(frozen=True)
class Learned:
    """What Q-learning made of its experience; O is the number of things it can see, all states unless said otherwise.

    Attributes:
        Q: [O, A].
        visits: [O, A], how often it tried each action.
        history: [K, O, A], Q after each number of steps that was asked for.
    """

    Q: Array
    visits: Integers
    history: Array

    @property
    def policy(self) -> Integers:
        """[O], the action it thinks best; of equals the first."""
        return self.Q.argmax(axis=1)


def q_learning(
    mdp: MDP,
    steps: int,
    rng: Generator,
    *,
    epsilon: float = 0.1,
    power: float = 0.6,
    episode: int | None = None,
    sees: ArrayLike | None = None,
    snapshots: Sequence[int] = (),
) -> Learned:
    """Learn from so many steps, epsilon-greedily, from Q = 0.

    Args:
        mdp: the world. Only its `Simulator` is asked, never its numbers.
        steps: of experience.
        rng: of all that is left to chance.
        epsilon: probability of an action at random, more than 0.
        power: alpha = n ** -power at the n-th visit of (s, a). Theorem 2.3 wants it above 1/2, that the squares have a
            finite sum, and at most 1, that the step sizes themselves have none.
        episode: steps after which an episode is cut off; Q-learning still counts on what would have come.
        sees: [S] whole numbers from 0, what the agent sees of each state. States that look alike to it share their
            row of Q, and the theorem does not speak about it any more.
        snapshots: after how many steps Q goes into `history`.

    Raises:
        ValueError: for a value outside its range.

    Example:
        >>> import numpy as np
        >>> from coil_rl.tabular import q_learning, toymaker
        >>> q_learning(toymaker(), 20_000, np.random.default_rng(0)).policy.tolist()
        [1, 1]
    """
    if not 0 < epsilon <= 1:
        raise ValueError(f"epsilon={epsilon} must be more than 0, or some actions are never tried, and at most 1")
    if not 0.5 < power <= 1:
        raise ValueError(
            f"power={power} must be more than 1/2 and at most 1: the step sizes n ** -power must have an infinite sum "
            "and their squares a finite one"
        )
    if wrong := [at for at in snapshots if not 0 <= at <= steps]:
        raise ValueError(f"snapshots: {wrong[0]} must be between 0 and steps={steps}")
    seen = np.arange(len(mdp.states)) if sees is None else np.asarray(sees)
    if seen.shape != (len(mdp.states),) or seen.dtype.kind not in "iu" or seen.min() < 0:
        raise ValueError(f"sees must be {len(mdp.states)} whole numbers from 0, one a state; got {seen.tolist()}")

    look, gamma, actions = seen.tolist(), mdp.gamma, len(mdp.actions)
    # Plain lists: one number at a time they are several times faster than arrays.
    Q = np.zeros((max(look) + 1, actions)).tolist()
    visits = np.zeros((max(look) + 1, actions), dtype=np.int64).tolist()
    world = Simulator(mdp, rng, episode)
    history = {0: np.array(Q)} if 0 in snapshots else {}
    wanted = set(snapshots)
    for step in range(1, steps + 1):
        row = Q[s := look[world.state]]
        a = int(rng.random() * actions) if rng.random() < epsilon else row.index(max(row))
        reward, following = world.step(a)
        visits[s][a] += 1
        alpha = visits[s][a] ** -power
        row[a] += alpha * (reward + gamma * max(Q[look[following]]) - row[a])
        if step in wanted:
            history[step] = np.array(Q)
    kept = np.array([history[at] for at in snapshots]).reshape(-1, *np.shape(Q))
    return Learned(np.array(Q), np.array(visits), kept)
