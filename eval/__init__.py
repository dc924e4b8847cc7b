"""Evaluation of policies.

Modules: ``experiment`` (plays a policy under conditions, and writes what it did), ``policy_spec`` (finds a policy) and
``baselines``, ``rollout`` and ``robot_loop`` (play episodes in an engine, and through a robot's loop), ``metrics`` (the
numbers of an episode), ``conditions`` (what can be changed), ``results`` (files), ``table`` and ``stats``, ``effects``
(what changes cost), ``film``; ``engines``, ``report``, ``study``, ``export`` and ``play``; ``verbs`` has the commands.
"""
