"""The operations that each iteration runs: compiled for the CPU and NVIDIA cards, in WGSL, and in plain torch."""
