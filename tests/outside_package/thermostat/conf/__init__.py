"""Configuration files, found by `--config-dir` or `hydra.searchpath=[pkg://thermostat.conf]`."""
