"""Tabular methods of the paper's second section.

In the paper's order: `mdp`, Markov decision processes as arrays; `planning`, dynamic programming
with a known model; `learning`, control from sampled transitions; `coil`, the same methods with a
guide's advice.
"""

from coil_paper.tabular.coil import observations_with_advice as observations_with_advice
from coil_paper.tabular.coil import with_advice as with_advice
from coil_paper.tabular.learning import ModelEstimate as ModelEstimate
from coil_paper.tabular.learning import Simulator as Simulator
from coil_paper.tabular.learning import Transitions as Transitions
from coil_paper.tabular.learning import q_learning as q_learning
from coil_paper.tabular.learning import sample_transitions as sample_transitions
from coil_paper.tabular.mdp import MDP as MDP
from coil_paper.tabular.mdp import garnet as garnet
from coil_paper.tabular.mdp import toymaker as toymaker
from coil_paper.tabular.planning import policy_evaluation as policy_evaluation
from coil_paper.tabular.planning import policy_iteration as policy_iteration
from coil_paper.tabular.planning import solve as solve
from coil_paper.tabular.planning import value_iteration as value_iteration
