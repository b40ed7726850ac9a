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
# # From a recording to a policy
#
# A robot was driven through a course of cones, and its LiDAR, its odometry and the commands were
# recorded. We read the recording, learn from it what its driver does, and let the result drive.
# There is no public recording of such a robot, so the drive is *simulated* here; with one of your
# own, begin at "Reading".

# %%
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
import torch
from IPython.display import Image
from matplotlib.figure import Figure
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv

import coil_rl
from coil_rl import McapReplayEnv, SimulatedRobotEnv, SplineGuide, evaluate_policy
from coil_rl.envs import Perception, read_recording, record_drives, simulated_cone_classifier
from coil_rl.imitation import NetworkRegressor
from coil_robot import recorded_steering

matplotlib.use("Agg")  # whatever MPLBACKEND names
torch.set_num_threads(1)
torch.manual_seed(0)
folder = Path(tempfile.mkdtemp())

# %% [markdown]
# ## A drive
#
# The driver is a hand-written rule that steers along a spline between the cones; four drives of a
# lap that differ by the noise of the LiDAR.

# %%
driver = SplineGuide()
robots = SimulatedRobotEnv(num_envs=4, laps=1, seed=0)
files = [folder / f"drive_{number}.mcap" for number in range(4)]
record_drives(robots, driver, files, about={"driver": "spline"})
[f"{file.name}: {file.stat().st_size // 1000} kB" for file in files]

# %% [markdown]
# ## Reading
#
# `McapReplayEnv` replays recordings as an env, one scan a step: what the robot perceived is the
# observation, as in the cone world. The command of each scan is the action of the driver, as a
# steering angle in units of 80 degrees.

# %%
recordings = [read_recording(file) for file in files]
perception = Perception(simulated_cone_classifier())
replay = McapReplayEnv(recordings, perception)
observations, actions = [], []
for row, recording in enumerate(recordings):
    steering = recorded_steering(recording, replay.speed, replay.car_length, replay.max_steering)
    seen = replay.rollout(len(steering.action) - 1, break_when_any_done=False)["observation"][row]
    observations.append(seen)
    actions.append(torch.as_tensor(steering.action[: len(seen)], dtype=torch.float32))
x, y = torch.cat(observations), torch.cat(actions).unsqueeze(-1)
known = y.isfinite().squeeze(-1)
x, y = x[known], y[known]
print(f"{len(x)} scans with a command, steering from {y.min():.2f} to {y.max():.2f}")

# %% [markdown]
# ## Learning
#
# Imitation is regression from what was seen to what was done. The last drive is left out: the
# error there says how well the driver can be predicted.

# %%
last = len(observations[-1])
network = NetworkRegressor(hidden=(64, 64), epochs=60, seed=0).fresh(x.shape[1], 1)
network.fit(x[:-last], y[:-last])
with torch.no_grad():
    predicted = network(x[-last:])
error = (predicted - y[-last:]).square().mean()
print(f"share of the variance that is explained: {1 - float(error / y[-last:].var()):.2f}")

# %%
figure = Figure(figsize=(7, 2.4), layout="constrained")
axes = figure.add_subplot(xlabel="scan of the last drive", ylabel="steering")
axes.plot(y[-last:].numpy(), color="#4d4d4d", lw=1.2, label="driver")
axes.plot(predicted.numpy(), color="#d55e00", lw=1.0, label="network")
axes.legend(frameon=False, ncols=2)
figure.savefig(folder / "fit.png", dpi=100)
Image(folder / "fit.png")

# %% [markdown]
# ## Driving
#
# A good fit is no good driver yet: small errors lead to places that are in no recording. So it
# drives, with other noise than in the recordings.


# %%
class Clipped(torch.nn.Module):
    """The network, within the bounds of the action."""

    def forward(self, observation):
        """Return the steering, [B, 1]."""
        return network(observation).clamp(-1, 1)


policy = TensorDictModule(Clipped(), ["observation"], ["action"])
for name, drives in (("driver", driver), ("network", policy)):
    robots = SimulatedRobotEnv(num_envs=4, laps=1, seed=100)
    result = evaluate_policy(robots, drives)
    rewards = [episode["reward"] for episode in result.episodes]
    steps = [episode["steps"] for episode in result.episodes]
    print(f"{name:8} reward {np.mean(rewards):6.1f}, steps {steps}")

# %% [markdown]
# ## As a guide
#
# Where the imitation fails, it may still be worth listening to. As a guide it gives advice, and
# the policy that learns decides what to do with it. `guide=learned` takes the policy of a finished
# run; from Python the network is a guide as it is:

# %%
cars = coil_rl.ConeTrackEnv(coil_rl.shipped_tracks("train"), num_envs=8, seed=0)
env = TransformedEnv(cars, coil_rl.GuideActions({"imitation": policy}))
agent = coil_rl.PPO(env, in_keys=["observation", "guide_action"])
metrics = agent.update(coil_rl.Rollout(env, agent.policy, steps=32).collect())
sorted(metrics)[:3]
