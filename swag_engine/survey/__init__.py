"""Surveys larger than one machine: blocks that are trained apart, and what is made of them."""
