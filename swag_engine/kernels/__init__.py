"""The operations that each iteration runs: compiled for the CPU, for NVIDIA cards, and in plain torch."""
