"""The Gaussians that are optimised, their densification and relocation."""
