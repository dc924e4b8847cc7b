"""Rotations, kinematic trees, shapes, surfaces and distances: what lies beneath objects, robots, retargeting and
engines."""
