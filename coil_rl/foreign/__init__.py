"""One door for envs and controllers of other people.

What they return is checked before anything computes with it, so that a fault in them is one
sentence with its place.
"""
