"""Runs about runs: training with a report, forecasts, ablations, trade-offs, evaluation."""
