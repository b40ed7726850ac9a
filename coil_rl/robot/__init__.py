"""The robot's cone classifier: training and evaluation."""
