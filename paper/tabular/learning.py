"""Learning from experience: a simulator, a model estimate, and Q-learning.

The estimate of the model follows equations 50 and 51 of the paper, Q-learning equation 52: it
updates Q(s, a) <- Q(s, a) + alpha (r + gamma max Q(s', .) - Q(s, a)) after each step. Q
converges to the optimal Q if every action is taken infinitely often in every state, and the step
sizes alpha of each pair have an infinite sum and their squares a finite one (theorem 2.3).
`epsilon` provides the first, `power` the second.
"""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from coil_paper.tabular.mdp import MDP, Array, Integers
from coil_rl.ranges import Count, Interval, checked

Epsilon = Annotated[float, Interval(gt=0, le=1)]
Power = Annotated[float, Interval(gt=0.5, le=1)]


@checked
class Simulator:
    """Step-by-step simulation of a Markov decision process.

    Args:
        mdp: the world.
        rng: of the start states and of the transitions.
        episode_steps: an episode ends in a terminal state, or after this number of steps; None for
            no limit.

    Attributes:
        state: the present state.
        steps: number of steps in the present episode.
    """

    def __init__(self, mdp: MDP, rng: Generator, episode_steps: Count | None = None) -> None:
        self.rng, self.episode_steps = rng, episode_steps
        # Plain lists: element by element they are several times faster than arrays.
        self._next, self._rewards = _cumulative(mdp.P).tolist(), mdp.R.tolist()
        self._start, self._terminal = _cumulative(mdp.start).tolist(), mdp.terminal.tolist()
        self.reset()

    def reset(self) -> None:
        """Draw a start state."""
        self.state, self.steps = bisect_right(self._start, self.rng.random()), 0

    def step(self, action: int) -> tuple[float, int]:
        """Take an action; return its reward and the next state.

        At the end of an episode the next one begins: then `state` is its start state, and not the
        state that is returned.
        """
        next_state = bisect_right(self._next[self.state][action], self.rng.random())
        reward = self._rewards[self.state][action][next_state]
        self.state, self.steps = next_state, self.steps + 1
        if self._terminal[next_state] or self.steps == self.episode_steps:
            self.reset()
        return reward, next_state


@dataclass(frozen=True)
class Transitions:
    """N sampled transitions.

    Attributes:
        state: [N], the state before each transition.
        action: [N], the action in it.
        reward: [N], the reward of the transition.
        next_state: [N], the state after it.
    """

    state: Integers
    action: Integers
    reward: Array
    next_state: Integers


def sample_transitions(
    mdp: MDP, policy: ArrayLike, steps: int, rng: Generator, episode_steps: int | None = None
) -> Transitions:
    """Sample consecutive transitions of a policy.

    Args:
        policy: actions [S], or their probabilities [S, A].
        steps: N, the number of transitions.
        rng: of the world and of the actions.
        episode_steps: number of steps after which an episode is truncated; None for no limit.
    """
    choices = _cumulative(mdp.probabilities(policy)).tolist()
    world = Simulator(mdp, rng, episode_steps)
    rows = []
    for _ in range(steps):
        state = world.state
        action = bisect_right(choices[state], rng.random())
        rows.append((state, action, *world.step(action)))
    return Transitions(*map(np.array, zip(*rows, strict=True)))


class ModelEstimate:
    """Maximum-likelihood estimate of P and R from transitions (equations 50 and 51).

    Args:
        states: S, the number of states.
        actions: A, the number of actions.
    """

    def __init__(self, states: int, actions: int) -> None:
        self.counts: Array = np.zeros((states, actions, states))  # number of observed transitions
        self.rewards: Array = np.zeros((states, actions, states))  # sum of their rewards

    def add(self, transitions: Transitions) -> None:
        """Count more transitions."""
        index = (transitions.state, transitions.action, transitions.next_state)
        np.add.at(self.counts, index, 1)
        np.add.at(self.rewards, index, transitions.reward)

    @property
    def P(self) -> Array:  # noqa: N802
        """[S, A, S]: N(s, a, s') / N(s, a) (equation 50); NaN for an action without samples."""
        total = self.counts.sum(axis=2, keepdims=True)
        return np.divide(self.counts, total, out=np.full_like(self.counts, np.nan), where=total > 0)

    @property
    def R(self) -> Array:  # noqa: N802
        """[S, A, S]: mean reward of each transition (equation 51); 0 for one without samples."""
        return np.divide(
            self.rewards, self.counts, out=np.zeros_like(self.rewards), where=self.counts > 0
        )

    def mdp(self, gamma: float) -> MDP:
        """Return the estimate as a world to plan in.

        Args:
            gamma: the discount factor, from 0 to less than 1.

        Raises:
            ValueError: if an action has no sample in some state.
        """
        missing = np.argwhere(self.counts.sum(axis=2) == 0)
        if len(missing):
            state, action = missing[0]
            raise ValueError(
                f"action {action} has no sample in state {state}, "
                f"nor have {len(missing) - 1} other pairs; "
                "add transitions of a policy that takes every action"
            )
        return MDP(self.P, self.R, gamma)


@dataclass(frozen=True)
class QLearningResult:
    """The learned Q.

    O is the number of observations, which are the states unless specified otherwise.

    Attributes:
        Q: [O, A], the estimated value of each action.
        history: [K, O, A], Q after each of the K requested numbers of steps.
    """

    Q: Array
    history: Array

    @property
    def policy(self) -> Integers:
        """[O], the greedy action; the first of equals."""
        return self.Q.argmax(axis=1)


@checked
def q_learning(
    mdp: MDP,
    steps: int,
    rng: Generator,
    *,
    epsilon: Epsilon = 0.1,
    power: Power = 0.6,
    episode_steps: Count | None = None,
    observations: ArrayLike | None = None,
    snapshots: Sequence[int] = (),
) -> QLearningResult:
    """Learn epsilon-greedily from Q = 0.

    Args:
        mdp: the world; the learner uses its `Simulator` only.
        rng: of the world and of the actions.
        epsilon: probability of a random action; above 0, so that every action is tried.
        power: alpha = n ** -power at the n-th visit of (s, a); above 1/2 and at most 1, or Q need
            not converge (theorem 2.3).
        episode_steps: steps after which an episode is truncated, None for no limit; the last
            state's value is still bootstrapped.
        observations: [S] integers from 0, the observation of each state. States with the same
            observation share their row of Q, and the theorem no longer applies.
        snapshots: numbers of steps after which Q is added to `history`.

    Example:
        >>> import numpy as np
        >>> from coil_paper.tabular import q_learning, toymaker
        >>> q_learning(toymaker(), 20_000, np.random.default_rng(0)).policy.tolist()
        [1, 1]
    """
    for snapshot in snapshots:
        if not 0 <= snapshot <= steps:
            raise ValueError(f"snapshots: {snapshot} must be between 0 and steps={steps}")
    # Plain lists: element by element they are several times faster than arrays.
    observation = _observations(len(mdp.states), observations).tolist()
    actions = len(mdp.actions)
    Q = np.zeros((max(observation) + 1, actions)).tolist()
    visits = np.zeros((max(observation) + 1, actions), dtype=np.int64).tolist()
    world = Simulator(mdp, rng, episode_steps)
    history = {}
    if 0 in snapshots:
        history[0] = np.array(Q)
    for step in range(1, steps + 1):
        o = observation[world.state]
        row = Q[o]
        if rng.random() < epsilon:
            a = int(rng.random() * actions)
        else:
            a = row.index(max(row))
        reward, next_state = world.step(a)
        visits[o][a] += 1
        alpha = visits[o][a] ** -power
        row[a] += alpha * (reward + mdp.gamma * max(Q[observation[next_state]]) - row[a])
        if step in snapshots:
            history[step] = np.array(Q)
    ordered = np.array([history[step] for step in snapshots]).reshape(-1, *np.shape(Q))
    return QLearningResult(np.array(Q), ordered)


def _observations(states: int, observations: ArrayLike | None) -> Integers:
    """Return the observation of each state, [S]; by default the state itself."""
    if observations is None:
        return np.arange(states)
    observed = np.asarray(observations)
    if observed.shape != (states,) or observed.dtype.kind not in "iu" or observed.min() < 0:
        raise ValueError(
            f"observations must be {states} integers from 0, one a state; got {observed.tolist()}"
        )
    return observed


def _cumulative(probabilities: Array) -> Array:
    """Return the cumulative distribution along the last axis; it ends at exactly 1."""
    # A draw below 1 must never select an outcome of probability 0.
    total = probabilities.cumsum(axis=-1)
    return total / total[..., -1:]
