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
# # Your env and controller, as a notebook
#
# A tank is filled by a pump and emptied through a hole. A proportional controller holds its level,
# a little too low. We write both, check them, and train a policy that starts as the controller.
# Everything is small, so that the page builds in seconds.

# %%
import tempfile
from pathlib import Path

import gymnasium
import matplotlib
import numpy as np
from gymnasium import spaces
from IPython.display import Image

import coil_rl
from coil_rl.guides import ControllerGuide

matplotlib.use("Agg")  # whatever MPLBACKEND names

# %% [markdown]
# ## The env
#
# Any Gymnasium env will do. Numbers may have physical units, here metres and litres per second:
# the policy sees both normalised. An episode has an end, and `reset` obeys its seed.


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


# %% [markdown]
# ## The controller
#
# A class with `act(observation)` that returns the action in the env's unit. One with a memory
# would have `reset()` too.


# %%
class Proportional:
    """Pumps in proportion to what is missing, and so never quite enough."""

    def act(self, observation):
        """Return litres per second, [1]."""
        level, wish = observation
        return [8.0 * max(wish - level, 0.0)]


# %% [markdown]
# ## The checks
#
# They take a second, and find what is hard to find in a learning curve: a reset that ignores its
# seed, values beyond their bounds, advice of the wrong shape.

# %%
tanks = coil_rl.GymnasiumEnv(Tank, num_envs=2)
coil_rl.check_env(tanks)
coil_rl.check_guide(ControllerGuide(Proportional), tanks)

# %% [markdown]
# ## Training
#
# With a guide the method is `coil_anchored`: a test finds whether the controller is worth starting
# from, and at the end the best of what was tried is handed over. The folder is a run for every
# program, such as `coil-evaluate run=FOLDER`.

# %%
folder = Path(tempfile.mkdtemp()) / "tank"
run = coil_rl.train(
    Tank,
    guide=Proportional,
    frames=20_000,
    folder=folder,
    overrides=["evaluation.gif=false", "logger=none"],
)

# %% [markdown]
# ## What came of it
#
# Controller and policy in the same episodes. One seed decides nothing about the method; it is
# enough to see whether this policy is better than this controller in these episodes.

# %%
table = run.evaluate(cases=20)
table.groupby(["driver", "actions"])["reward"].agg(["mean", "min"]).round(2)

# %%
Image(folder / "learning_curve.png", width=560)

# %% [markdown]
# ## What the machine is sent
#
# `controller()` holds the policy with the advice, the normalisation and any memory inside. It
# takes what the sensor says and returns litres per second.

# %%
controller = run.controller()
controller.reset()
for level in (0.5, 0.9, 1.0, 1.5):
    flow = float(controller.act(np.array([level, 1.0], np.float32))[0])
    print(f"level {level:.1f} m: {flow:5.2f} l/s")
