"""Train and evaluate 3D Gaussians of underwater scenes, with the water taken away."""
