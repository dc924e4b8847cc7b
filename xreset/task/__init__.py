"""The task: actions, observations, reward and ends of episodes as pure functions over batched tensors; and what differs
between worlds and episodes (``variation``, ``vision``), in fixed buffers."""
