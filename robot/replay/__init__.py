"""Open-loop replay of recorded drives.

It shows what policies would have steered at each scan, and how much they disagree.
"""
