"""Policies as files: the ONNX graph with its contract, and the policies that ship."""
