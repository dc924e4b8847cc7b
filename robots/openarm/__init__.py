"""OpenArm v1.0, right arm with its parallel gripper."""
