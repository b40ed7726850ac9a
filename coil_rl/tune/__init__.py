"""`method=tune`: better numbers for a guide, searched by CMA-ES in complete episodes."""

from coil_rl.tune.method import Tuning as Tuning
