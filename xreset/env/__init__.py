"""The environment, and its faces for Gymnasium and Stable-Baselines3."""
