"""`method=tune`: better numbers for a guide, searched by CMA-ES in complete episodes."""
