"""Tabular methods of the paper's second section.

In the paper's order: `mdp`, Markov decision processes as arrays; `planning`, dynamic programming with a known model;
`learning`, control from sampled transitions; `coil`, the same methods with a guide's advice.
"""

from coil_rl.tabular.coil import observations_with_advice, with_advice
from coil_rl.tabular.learning import (
    ModelEstimate,
    QLearningResult,
    Simulator,
    Transitions,
    q_learning,
    sample_transitions,
)
from coil_rl.tabular.mdp import MDP, garnet, toymaker
from coil_rl.tabular.planning import PlanningResult, policy_evaluation, policy_iteration, solve, value_iteration

__all__ = [
    "MDP",
    "ModelEstimate",
    "PlanningResult",
    "QLearningResult",
    "Simulator",
    "Transitions",
    "garnet",
    "observations_with_advice",
    "policy_evaluation",
    "policy_iteration",
    "q_learning",
    "sample_transitions",
    "solve",
    "toymaker",
    "value_iteration",
    "with_advice",
]
