"""Learning: rsl-rl PPO with a PointNet, LSTM and MLP model."""
