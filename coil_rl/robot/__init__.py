"""The robot's cone classifier, and recorded drives of guides and agents on the simulated robot."""
