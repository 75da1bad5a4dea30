"""Images, cameras and sparse points."""
