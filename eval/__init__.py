"""Evaluation of policies.

Modules: ``evaluate`` (the whole), ``policy_spec`` (finds a policy, and has the baseline ``ik``), ``rollout`` (plays
episodes in an engine), ``metrics`` (what success is), ``results`` (files and tables); ``stress`` and ``sensitivity``
(sweeps of physical properties), ``select`` (checkpoints), ``rehearse`` (the loop of a robot); ``engines``, ``report``,
``study``, ``export`` and ``play``.
"""
