"""The YAML files of the robot; Hydra finds them beside those of `coil_rl.conf`."""
