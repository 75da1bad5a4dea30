"""Time, speed and memory of a run."""
