"""Web viewers render an exported GLB through its glTF camera as the engine does; the browser has no graphics card."""

import cv2
import numpy as np
import pytest
import torch

from swag_engine.formats.cameras import transform_camera
from swag_engine.formats.gltf import write_glb
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.splats.splats import Splats
from swag_engine.splats.transform import transformed

WIDTH, HEIGHT = 320, 200


def heap():
    """2000 splats of every shape and color in front of the origin; without any symmetry."""
    random = np.random.default_rng(3)
    count = 2000
    rotations = random.normal(size=(count, 4))
    sh = random.normal(size=(count, 16, 3)) * 0.15
    sh[:, 0] = random.uniform(-1.2, 1.5, (count, 3))
    columns = (
        np.c_[random.uniform(-3, 3, (count, 2)), random.uniform(3, 9, count)],
        rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
        np.exp(random.uniform(np.log(0.02), np.log(0.3), (count, 3))),
        random.uniform(0.1, 1, count),
        sh,
    )
    positions, rotations, scales, opacities, sh = (column.astype(np.float32) for column in columns)
    return Splats(positions, rotations, scales, opacities, sh)


def side_camera():
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.1, 0.3, -0.2]))[0]
    pose[:3, 3] = 0.2, 0.4, 0.6
    return Camera("side", WIDTH, HEIGHT, 220.0, 220.0, WIDTH / 2, HEIGHT / 2, np.linalg.inv(pose))


def render_by_engine(splats, camera):
    positions, rotations, scales, opacities, sh = (
        torch.from_numpy(array)
        for array in (splats.positions, splats.rotations, splats.scales, splats.opacities, splats.sh)
    )
    cloud = GaussianCloud(
        positions, rotations, scales.log(), torch.logit(opacities, 1e-6), sh[:, :1], sh[:, 1:], torch.full((3,), -30.0)
    )
    return render(cloud, camera).color.numpy().clip(0, 1)


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
