"""Franka Panda arm with the Allegro right hand."""
