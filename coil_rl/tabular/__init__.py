"""The classical methods on worlds that fit into a table, to be read beside the paper's second section.

In the order of the paper: `mdp`, the world; `planning`, what to do where it is known; `simulator`, living in it;
`estimates`, getting to know it; `q_learning`, what to do without knowing it; `coil`, the same with a guide's advice.
"""

from coil_rl.tabular.coil import sees_advice, with_advice
from coil_rl.tabular.estimates import ModelEstimate
from coil_rl.tabular.garnet import garnet
from coil_rl.tabular.gridworld import Gridworld
from coil_rl.tabular.mdp import MDP
from coil_rl.tabular.planning import Plan, policy_evaluation, policy_iteration, solve, value_iteration
from coil_rl.tabular.q_learning import Learned, q_learning
from coil_rl.tabular.simulator import Experience, Simulator, experience
from coil_rl.tabular.toymaker import toymaker

__all__ = [
    "MDP",
    "Experience",
    "Gridworld",
    "Learned",
    "ModelEstimate",
    "Plan",
    "Simulator",
    "experience",
    "garnet",
    "policy_evaluation",
    "policy_iteration",
    "q_learning",
    "sees_advice",
    "solve",
    "toymaker",
    "value_iteration",
    "with_advice",
]
