"""The kinds of cameras that images are rendered with."""

from typing import Literal

CameraKind = Literal["perspective", "orthographic"]
"""perspective: u = fx x / z + cx, v = fy y / z + cy; orthographic: u = fx x + cx, v = fy y + cy, fx and fy in pixels
per scene unit."""
