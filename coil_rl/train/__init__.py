"""Training runs: configuration, construction of the parts, rollouts, updates, evaluation, checkpoints, run folders."""

import coil_rl.train.config  # noqa: F401  registers the root configurations and resolvers with Hydra
