"""A training run: configuration, building of parts, rollouts, updates, evaluation, checkpoints and the run folder."""
