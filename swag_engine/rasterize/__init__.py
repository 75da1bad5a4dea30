"""From Gaussians to pixels, whatever channels they have."""
