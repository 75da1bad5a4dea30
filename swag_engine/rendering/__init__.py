"""From a scene model to images, and from photos to the colors of the place."""
