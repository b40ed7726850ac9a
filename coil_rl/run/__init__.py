"""One training run: its envs, rollouts, training loop, evaluation, checkpoints and folder; without YAML."""
