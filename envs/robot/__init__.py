"""A simulated robot with a LiDAR, and the perception of cones in its scans."""
