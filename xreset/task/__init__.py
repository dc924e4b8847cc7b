"""The task as pure functions over batched tensors: observations, reward, terminations, resets, randomisation."""
