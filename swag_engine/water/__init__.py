"""The medium between camera and surface."""
