"""The YAML files of the studies; Hydra finds them beside those of `coil_rl.conf`."""
