"""Open-loop replay of recorded drives: what policies would have steered, and how much they disagree."""
