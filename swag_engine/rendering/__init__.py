"""From a scene model to images."""
