"""What images and sparse points say about the water, the lamp and the camera."""
