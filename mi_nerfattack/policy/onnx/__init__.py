"""Policies from ONNX files, with derivatives."""
