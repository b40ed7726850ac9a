"""One door for envs and controllers of other people.

What they return is checked before anything computes with it, so that a fault in them is one
sentence with its place.

| file | what is in it |
| --- | --- |
| `faults` | checks of what comes back, and `ForeignError` |
| `plant` | one env of Gymnasium or TorchRL: reset, step, picture, limit of steps (`limit`) |
| `codec` | the spaces of a Gymnasium env as entries and actions |
| `rows`, `workers`, `batch` | plants side by side, over processes, and as a batched env |
| `gymnasium_env`, `torchrl_env` | the two envs, made by `makers` |
| `host` | whatever acts for one row; the only place that decides what it is |
| `controllers`, `shared`, `remembered` | as guides, one a row or one for all; checkpoints |
| `trial` | a few steps of an env and of a controller, twice |
"""
