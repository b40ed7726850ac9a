"""Robot recordings: reading, writing and replaying MCAP files and rosbag2 folders."""
