"""Evaluation: rollouts, metrics, baselines, report."""
