"""Web viewers render an exported GLB through its glTF camera as the engine does; the browser has no graphics card."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from swag_engine.formats.cameras import transform_camera
from swag_engine.formats.gltf import write_glb
from swag_engine.scene.cameras import Camera
from swag_engine.splats.transform import transformed
from tests.scenes.clouds import draw_splats, random_splats

WIDTH, HEIGHT = 320, 200


def heap():
    """2000 splats of every shape and color in front of the origin; without any symmetry."""
    splats = random_splats(2000, [3, 3, 3], (np.log(0.02), np.log(0.3)))
    return replace(splats, positions=splats.positions + np.array([0, 0, 6], np.float32))


def side_camera():
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.1, 0.3, -0.2]))[0]
    pose[:3, 3] = 0.2, 0.4, 0.6
    return Camera("side", WIDTH, HEIGHT, 220.0, 220.0, WIDTH / 2, HEIGHT / 2, np.linalg.inv(pose))


def render_by_engine(splats, camera):
    return draw_splats(splats, camera).color.numpy().clip(0, 1)


@pytest.mark.parametrize("page", ["babylon.html", "playcanvas.html"])
def test_a_viewers_image_equals_the_engines(browser, tmp_path, page):
    """The up direction is no axis, and the scene was rotated and scaled: both images are equal."""
    turn = np.eye(4)
    turn[:3, :3] = 1.7 * cv2.Rodrigues(np.array([-0.4, 1.1, 0.3]))[0]
    turn[:3, 3] = 1, -2, 3
    splats, camera = transformed(heap(), turn), transform_camera(side_camera(), turn)
    write_glb(tmp_path / "heap.glb", splats, (0.1, -0.9, 0.2), [camera])
    png = browser(page, tmp_path / "heap.glb", WIDTH, HEIGHT)
    (tmp_path / page).with_suffix(".png").write_bytes(png)
    theirs = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1] / 255
    ours = render_by_engine(heap(), side_camera())
    cv2.imwrite(str(tmp_path / "engine.png"), (ours[..., ::-1] * 255).round().astype(np.uint8))
    psnr, mirrored = (-10 * np.log10(np.mean((picture - ours) ** 2)) for picture in (theirs, theirs[:, ::-1]))
    print(page, psnr)
    assert psnr > 30 and mirrored < 20 and ours.mean() > 0.2
