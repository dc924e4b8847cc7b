"""Evaluation episodes for others: as a LeRobot data set, or as plain arrays."""
