"""Training runs: configuration, construction of the parts, rollouts, updates, evaluation, checkpoints, run folders."""
