"""A heated room: `thermostat:Room-v0` for Gymnasium, `Rooms` for TorchRL, and their controllers."""

import gymnasium

gymnasium.register("Room-v0", entry_point="thermostat.room:Room", max_episode_steps=96)
