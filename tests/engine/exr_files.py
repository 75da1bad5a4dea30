"""Reading of OpenEXR files."""

import os
import subprocess
import sys

import numpy as np


def read_exr(path):
    """Read an EXR with OpenCV, in a process in which its reader is switched on."""
    code = "import cv2, numpy, sys; numpy.save(sys.argv[2], cv2.imread(sys.argv[1], cv2.IMREAD_UNCHANGED))"
    out = path.with_suffix(".npy")
    environment = os.environ | {"OPENCV_IO_ENABLE_OPENEXR": "1"}
    subprocess.run([sys.executable, "-c", code, str(path), str(out)], check=True, env=environment)
    return np.load(out)
