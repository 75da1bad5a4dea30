"""Surveys of more images than one run can hold: cut into blocks that are trained on their own, and merged."""
