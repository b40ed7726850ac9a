# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Is my guide worth it?
#
# Whether a controller helps a policy to learn cannot be seen from the outside. `coil_rl.compare`,
# or `coil-compare` on the command line, measures it: it drives the controller, its opposite and
# random actions, tunes the controller, and trains a few policies for a short time with and without
# it. This page asks it about the tank of the page before, whose level is held a little too low.

# %%
import tempfile
from pathlib import Path

import gymnasium
import matplotlib
import numpy as np
from gymnasium import spaces
from IPython.display import Image

import coil_rl

matplotlib.use("Agg")  # whatever MPLBACKEND names
folder = Path(tempfile.mkdtemp()) / "tank"


# %%
class Tank(gymnasium.Env):
    """A tank with a hole; the reward is the distance of the level from 1 m, and the power."""

    observation_space = spaces.Box(0.0, 3.0, (2,), np.float32)  # level and wish, m
    action_space = spaces.Box(0.0, 20.0, (1,), np.float32)  # litres per second
    max_steps = 60  # of an episode

    def reset(self, *, seed=None, options=None):
        """Begin with any level."""
        super().reset(seed=seed)
        self.level = self.np_random.uniform(0.2, 2.0)
        self.left = self.max_steps
        return self._seen(), {}

    def step(self, action):
        """Pump for a second."""
        flow = float(action[0])
        self.level += 0.02 * flow - 0.1 * np.sqrt(self.level)
        self.level = float(np.clip(self.level, 0.0, 3.0))
        self.left -= 1
        reward = -abs(self.level - 1.0) - 0.002 * flow
        return self._seen(), reward, False, self.left == 0, {}

    def _seen(self):
        return np.array([self.level, 1.0], np.float32)


# %%
class Proportional:
    """Pumps in proportion to what is missing, and so never quite enough."""

    def __init__(self, gain=8.0):
        self.gain = gain

    def act(self, observation):
        """Return litres per second, [1]."""
        level, wish = observation
        return [self.gain * max(wish - level, 0.0)]


# %% [markdown]
# ## The question
#
# `tune` names a number of the controller and its bounds: perhaps another gain is all it needs. The
# frames are those of a whole training, of which each one here gets a tenth. It says first how long
# it will take.

# %%
found = coil_rl.compare(
    Tank,
    guide=Proportional,
    tune={"gain": [1.0, 200.0, "log"]},
    minutes=1,
    frames=40_000,
    folder=folder,
    overrides=["budget.steps=64", "evaluation.cases=5", "evaluation.curve.num_envs=5"],
)

# %% [markdown]
# ## The answer
#
# The page begins with three sentences: what to use, what it gained, and what is undecided. With two
# seeds and a tenth of the frames much is. The curves have each seed as a thin line.

# %%
Image(folder / "compare.png", width=640)

# %% [markdown]
# ## What now?
#
# The command at the end of the page trains what is recommended, with all frames. `found.table` has
# the numbers, and the folder is one of runs for every program, such as `coil-report folder=FOLDER`.

# %%
print(found.verdict.use)
print(found.command)
