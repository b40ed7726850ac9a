"""Speed measurements, outside the installed package: `make bench` or `python -m benchmarks --help`."""
