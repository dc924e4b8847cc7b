"""Rotations, kinematic trees, shapes, surfaces and distances. Objects, robots, retargeting and engines build on them."""
