"""Native code for the CPU and for NVIDIA cards."""
