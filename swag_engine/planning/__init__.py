"""Decide which effects a scene calls for."""
