"""Retargeting: human hand motion to robot joint trajectories."""
