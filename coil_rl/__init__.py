"""Reinforcement learning with guide policies."""
