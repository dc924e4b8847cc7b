"""UR7e arm with the Robotiq 2F-85 gripper."""
