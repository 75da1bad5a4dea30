"""The optimisation of one scene."""
