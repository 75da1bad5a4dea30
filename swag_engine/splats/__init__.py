"""Splats as numpy arrays."""
