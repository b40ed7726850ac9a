"""Speed measurements: `make bench` or `python -m benchmarks --help`. They are not installed."""
