"""Robot recordings: reading, writing and replaying MCAP files and rosbag2 folders."""

from coil_rl.envs.recordings.recording import SIMULATED as SIMULATED
