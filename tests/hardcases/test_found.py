"""Regression tests of what fuzzing and random search found."""

import json
from typing import Any

import onnx
import onnx.parser
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from swag_engine.app.protocol import parse_request
from swag_engine.base.errors import InputError
from swag_engine.formats.run_folder import RunFolder
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.inspect import describe, inspect_scene
from swag_engine.training.losses import photometric
from swag_engine.water.medium import Medium
from swag_engine.weights.onnx import Network
from tests.scenes.tiny import make_tiny_scene

ANY = st.floats(width=32, allow_nan=True, allow_infinity=True)
CAMERA: dict[str, Any] = {"width": 16, "height": 12, "cx": 8.0, "cy": 6.0}


def numbers(count: int) -> st.SearchStrategy:
    return st.lists(ANY, min_size=count, max_size=count).map(lambda values: torch.tensor(values, dtype=torch.float32))


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(
    values=numbers(3 * (3 + 4 + 3 + 1 + 3)),
    water=st.none() | st.lists(st.floats(-(2.0**99), 2.0**99, width=32), min_size=9, max_size=9),
    focal=st.floats(1e-3, 1e6),
    pixel=st.floats(0, 1, width=32),
)
def test_any_three_gaussians_give_finite_images_and_gradients(backend, values, water, focal, pixel):
    """Any float32 in any parameter, any finite water, any focal length: finite loss and gradients."""
    means, quats, log_scales, logits, sh0 = values.split([9, 12, 9, 3, 9])
    sh0 = sh0.clamp(-1e10, 1e10)  # the squares of brighter images overflow; the guard skips such steps
    if water:  # it is shared by all Gaussians, so that NaN in one reaches all; the guard finds it
        means, sh0 = (torch.where(values.isnan(), 0.0, values) for values in (means, sh0))
    cloud = GaussianCloud(
        means.reshape(3, 3), quats.reshape(3, 4), log_scales.reshape(3, 3), logits, sh0.reshape(3, 1, 3),
        torch.zeros(3, 0, 3), torch.zeros(3),
    )  # fmt: skip
    medium = None
    if water:
        attenuation, backscatter, background = torch.tensor(water, dtype=torch.float32).split(3)
        medium = Medium(attenuation, backscatter, torch.cat([background[None], torch.zeros(8, 3)]), 1.0)
    leaves = [*cloud.parameters().values(), *(medium.parameters().values() if medium else ())]
    leaves = [leaf.requires_grad_() for leaf in leaves if leaf.numel()]
    camera = Camera("any", fx=focal, fy=focal, world_to_camera=torch.eye(4, dtype=torch.float64).numpy(), **CAMERA)
    picture = render(cloud, camera, 0, medium, backend=backend)
    assert picture.color.isfinite().all() and picture.alpha.isfinite().all()
    loss = photometric(picture.color, torch.full((12, 16, 3), pixel), None, backend=backend)
    loss.backward()
    finite = torch.stack([torch.isfinite(value.reshape(3, -1)).all(1) for value in cloud.parameters().values()
                          if value.dim() and len(value) == 3 and value is not cloud.background]).all(0)  # fmt: skip
    for leaf in leaves:
        if leaf.grad is not None and leaf is not cloud.background and len(leaf) == 3 and leaf.dim() > 0:
            rows = leaf.grad[finite] if any(leaf is value for value in cloud.parameters().values()) else leaf.grad
            assert rows.isfinite().all()


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@pytest.mark.parametrize("brightness, place", [(1e4, -5.0), (4.24e16, -5.0), (float("inf"), -5.0), (0.0, -1.9e19)])
def test_a_gaussian_out_of_view_does_not_change_gradients_of_the_water(backend, brightness, place):
    cloud = GaussianCloud(torch.tensor([[0.0, 0, place]]), torch.ones(1, 4), torch.zeros(1, 3), torch.zeros(1),
                          torch.full((1, 1, 3), brightness), torch.zeros(1, 0, 3), torch.zeros(3))  # fmt: skip
    medium = Medium.starting(1.0)
    parameters = [parameter.requires_grad_() for parameter in medium.parameters().values()]
    camera = Camera("any", fx=10.0, fy=10.0, world_to_camera=torch.eye(4, dtype=torch.float64).numpy(), **CAMERA)
    color = render(cloud, camera, 0, medium, backend=backend).color
    assert all(
        gradient.isfinite().all() for gradient in torch.autograd.grad(color.sum(), parameters, allow_unused=False)
    )


def test_a_network_whose_names_are_not_utf8_is_refused(tmp_path):
    graph = "net (float[1,3,Hxyz,W] image) => (float[1,3,Hxyz,W] out) { out = Relu(image) }"
    path = tmp_path / "net.onnx"
    onnx.save(onnx.parser.parse_model(f'<ir_version: 8, opset_import: ["": 17]> {graph}'), path)
    path.write_bytes(path.read_bytes().replace(b"Hxyz", b"H\xaa\xaaz"))
    with pytest.raises(InputError, match="net.onnx"):
        Network(path, "a network", [(1, 3, None, None)], [(1, 3, None, None)])


@pytest.mark.parametrize("far", ["1e60", "1e308"])
def test_a_point_that_is_too_far_away_is_left_out(tmp_path, far):
    """Blender places the root of cameras and splats at the mean of the points, which one such point would move."""
    scene = make_tiny_scene(tmp_path / "scene", views=3, points=5)
    points = scene / "sparse" / "0" / "points3D.txt"
    first, *others = points.read_text().splitlines()
    word = first.split()
    points.write_text("\n".join([" ".join([word[0], far, far, far, *word[4:]]), *others]) + "\n")
    loaded = load_scene(scene)
    assert len(loaded.points.positions) == 4 and "1 points of" in loaded.warnings[0]
    assert "Points:" in describe(inspect_scene(loaded))


@pytest.mark.parametrize("name", ["recipe", "effects", "backend", "water_type", "time_budget"])
@pytest.mark.parametrize("value", [{}, [], 3, None])
def test_settings_that_are_not_text_are_refused(name, value):
    with pytest.raises(InputError, match="must be a"):
        parse_request(json.dumps({"request": "train", "scene": "a", "out": "b", "settings": {name: value}}))


@pytest.mark.parametrize("text", ["{}", '{"interrupted": 3}', "[]", "[" * 100_000, '{"interrupted"'])
def test_damaged_metrics_are_refused(tmp_path, text):
    (tmp_path / "metrics.json").write_text(text)
    with pytest.raises(InputError, match="metrics.json"):
        RunFolder(tmp_path).finished()


@pytest.mark.parametrize("line", [b"\xff\xfe", b"3", b"[]", b'{"iteration": "x"}', b'{"iteration": 2, "lo'])
def test_a_damaged_line_of_metrics_is_dropped(tmp_path, line):
    (tmp_path / "metrics.jsonl").write_bytes(b'{"iteration": 1}\n' + line + b"\n")
    RunFolder(tmp_path).log_until(5)
    assert (tmp_path / "metrics.jsonl").read_text() == '{"iteration": 1}\n'
