"""Open-loop replay of recorded drives.

It shows what policies would have steered at each scan, and how much they disagree.
"""

from coil_rl.replay.open_loop import recorded_steering as recorded_steering
