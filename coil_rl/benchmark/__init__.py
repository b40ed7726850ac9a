"""What `coil-benchmark` measures, and the yardsticks it measures with."""
