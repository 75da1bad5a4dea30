"""Scale, axes and coordinates of a scene from coded targets, reference points, GPS and depths."""
