"""Reset banks: retargeted states that a physics engine has found stable."""
