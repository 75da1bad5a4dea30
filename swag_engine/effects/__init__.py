"""What is between a place and its photographs beside the water, and which of it a scene calls for."""
