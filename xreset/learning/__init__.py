"""Learning: rsl-rl's PPO with a PointNet, LSTM and MLP model.

Modules: ``train`` (the whole), ``runner`` (the loop), ``ppo`` or ``distillation`` (the update), ``model``, ``export``
(ONNX); ``config`` and ``recipes``; ``run`` and ``checkpoint`` (files); ``distributed`` (several GPUs); ``fused`` (the
PointNet as one GPU kernel).
"""
