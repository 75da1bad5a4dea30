"""Cameras of other programs: files of Metashape, RealityScan, nerfstudio and others become a COLMAP scene."""
