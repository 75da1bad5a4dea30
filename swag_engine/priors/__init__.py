"""Priors from networks: depth of single images, and frames between images."""
