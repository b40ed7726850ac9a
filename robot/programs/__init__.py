"""The console programs of the robot: `coil-replay` and `coil-drive`."""
