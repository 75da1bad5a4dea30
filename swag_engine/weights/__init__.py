"""Files of pretrained networks."""
