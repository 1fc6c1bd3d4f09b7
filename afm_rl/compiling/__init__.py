"""Compiling: export of modules to ONNX, and helpers that keep modules exportable."""
