"""UFACTORY xArm7 arm with the LEAP right hand."""
