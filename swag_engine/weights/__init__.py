"""Pretrained networks: which there are, where their files lie, how they run."""
