"""One training run, without YAML.

Its envs, rollouts, training loop, evaluation, checkpoints and folder are here.
"""
