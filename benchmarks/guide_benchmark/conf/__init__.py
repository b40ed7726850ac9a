"""Experiments of the guide benchmark with envs of other packages (YAML only)."""
