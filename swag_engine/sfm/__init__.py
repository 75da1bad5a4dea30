"""Structure from motion: photos or a video become a COLMAP scene."""
