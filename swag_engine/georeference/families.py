"""Families of coded targets, by the names that the command line and Blender use. Blender imports it."""

FAMILIES = {
    "aruco_4x4_50": "50 targets of 4 x 4 cells: few cells, so that they are read from far away and in murky water",
    "aruco_4x4_100": "100 targets of 4 x 4 cells",
    "aruco_4x4_250": "250 targets of 4 x 4 cells",
    "aruco_4x4_1000": "1000 targets of 4 x 4 cells",
    "aruco_5x5_50": "50 targets of 5 x 5 cells",
    "aruco_5x5_100": "100 targets of 5 x 5 cells",
    "aruco_5x5_250": "250 targets of 5 x 5 cells",
    "aruco_5x5_1000": "1000 targets of 5 x 5 cells",
    "aruco_6x6_50": "50 targets of 6 x 6 cells",
    "aruco_6x6_100": "100 targets of 6 x 6 cells",
    "aruco_6x6_250": "250 targets of 6 x 6 cells",
    "aruco_6x6_1000": "1000 targets of 6 x 6 cells",
    "aruco_7x7_50": "50 targets of 7 x 7 cells",
    "aruco_7x7_100": "100 targets of 7 x 7 cells",
    "aruco_7x7_250": "250 targets of 7 x 7 cells",
    "aruco_7x7_1000": "1000 targets of 7 x 7 cells",
    "aruco_original": "1024 targets of the first ArUco library",
    "aruco_mip_36h12": "250 targets of 6 x 6 cells that are hard to confuse",
    "apriltag_16h5": "30 AprilTags of 4 x 4 cells",
    "apriltag_25h9": "35 AprilTags of 5 x 5 cells",
    "apriltag_36h10": "2320 AprilTags of 6 x 6 cells",
    "apriltag_36h11": "587 AprilTags of 6 x 6 cells, the most common ones",
}
"""Name -> what the family is for, one sentence without its full stop."""
