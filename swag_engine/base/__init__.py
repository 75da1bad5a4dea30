"""Errors, files, JSON, threads, timing and transfer functions."""
