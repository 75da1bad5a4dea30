"""Motion in the scene, of which the matches between photos tell.

The patches have more matches than the scene, so that the initial pair of photos decides which model is found: from 2
and 4, a free focal length leaves out photo 0, which a held one places. The search of that pair is the same in each run.
"""

from pathlib import Path

import cv2
import numpy as np

from swag_engine.sfm.reconstruct import reconstruct
from tests.scenes.panels import SIZE, render

PATCHES = ((40, 25, 12, -9), (200, 35, -9, 13), (30, 130, 9, 14), (120, 75, -14, -3), (210, 130, -11, -13))
"""Column and row in the middle photo, and motion to the right and down from photo to photo, in pixels.

No motion of the camera explains all of them: of three that only move down, one did.
"""
SIDE = 85


def test_motion_in_the_scene_is_said(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    textures = [
        cv2.resize(random.integers(20, 190, (34, 34, 3), np.uint8), (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
        for _ in PATCHES
    ]
    (tmp_path / "photos").mkdir()
    for index, x in enumerate(np.linspace(-0.6, 0.6, 5)):
        photo = render(x)
        for texture, (column, row, right, down) in zip(textures, PATCHES, strict=True):
            left = min(max(column + right * (index - 2), 0), SIZE[0] - SIDE)
            top = min(max(row + down * (index - 2), 0), SIZE[1] - SIDE)
            photo[top : top + SIDE, left : left + SIDE] = texture
        (tmp_path / "photos" / f"{index}.png").write_bytes(cv2.imencode(".png", photo)[1].tobytes())
    result = reconstruct(tmp_path / "photos", tmp_path / "scene")
    assert result["registered"] == 5
    assert any("something moves" in warning for warning in result["warnings"]), result["contradicting_share"]
