"""The task: actions, observations, reward and ends of episodes are pure functions over batched tensors. Differences
between worlds and episodes (``variation``, ``vision``) are in fixed buffers."""
