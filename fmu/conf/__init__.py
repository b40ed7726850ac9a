"""The YAML files of the FMUs; Hydra finds them beside those of `coil_rl.conf`."""
