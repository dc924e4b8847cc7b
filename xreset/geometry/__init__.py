"""Rotations, kinematic trees, shapes, surfaces and distances, for objects, robots, retargeting and engines."""
