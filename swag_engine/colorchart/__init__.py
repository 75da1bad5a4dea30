"""Color charts in photos: find them, and compare the colors of their patches with known ones."""
