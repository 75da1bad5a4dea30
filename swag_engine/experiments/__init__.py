"""Experiments: training with a report, forecast, ablation, tradeoff, evaluation, labels of a run, restored photos."""
