"""Hydra configuration: every choice a person makes is a YAML file here."""
