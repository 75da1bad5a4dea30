"""Reading of OpenEXR files."""

import os
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest


def read_exr(path):
    """Read an EXR with OpenCV, in a process in which its reader is switched on; skip where it has none (5.0)."""
    if re.search(r"OpenEXR:\s+NO", cv2.getBuildInformation()):
        pytest.skip("This OpenCV is built without OpenEXR.")
    code = "import cv2, numpy, sys; numpy.save(sys.argv[2], cv2.imread(sys.argv[1], cv2.IMREAD_UNCHANGED))"
    out = path.with_suffix(".npy")
    environment = os.environ | {"OPENCV_IO_ENABLE_OPENEXR": "1"}
    subprocess.run([sys.executable, "-c", code, str(path), str(out)], check=True, env=environment)
    return np.load(out)
