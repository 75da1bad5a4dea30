"""Pretrained networks: where their files are, and how ONNX files are run."""
