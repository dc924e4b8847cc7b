"""The task: actions, observations, reward and ends of episodes are pure functions over batched tensors. Differences
between worlds and episodes (``variation``, ``vision``) are in fixed buffers.

Modules: ``config`` (every setting), ``actions``, ``reading`` (what is read after a step), ``rewards``,
``terminations``, ``observations``; ``variation`` draws physical parameters and faults with each episode, from
``randomization``, ``latency``, ``tracker`` and ``pushes``; ``vision`` has the cameras, ``contract`` what an exported
policy states.
"""
