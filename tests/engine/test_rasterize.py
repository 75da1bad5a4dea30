"""The rasteriser: projection and blending against their definitions, the kernels against the reference."""

import ctypes
import math
import warnings

import pytest
import torch

from swag_engine.base.errors import InputError
from swag_engine.kernels import build, cpu_library, protocol
from swag_engine.kernels.backends import KERNELS
from swag_engine.kernels.cpu import CpuKernels
from swag_engine.kernels.cpu_library import CpuLibrary
from swag_engine.kernels.reference.projection import project
from swag_engine.rasterize.api import contributions, rasterize
from swag_engine.settings.settings import BACKENDS
from tests.engine.kernel_suite import KernelSuite
from tests.engine.raster_scenes import (
    GRADIENTS,
    HARD,
    blend_by_definition,
    changed,
    clear_scenes,
    make_scene,
    orthographic,
    relative_error,
    run,
)

# -- projection --------------------------------------------------------------------------------------------------------


def rotation_matrix(quat):
    """By the exponential of the axis-angle vector: no formula shared with the engine."""
    w, *axis = (quat / quat.norm()).tolist()
    length = math.hypot(*axis)
    x, y, z = (2 * math.atan2(length, w) * v / length for v in axis)
    return torch.linalg.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64))


def test_projection_is_the_linearised_camera():
    scene = make_scene(30, seed=4)
    arguments = [
        scene[k] for k in ("means", "quats", "scales", "opacities", "channels", "viewmat", "K", "width", "height")
    ]
    projected = project(*arguments)
    checked = 0
    for i in range(30):
        camera = scene["viewmat"][:3, :3] @ scene["means"][i] + scene["viewmat"][:3, 3]
        if projected.radii[i] == 0 or (camera[:2] / camera[2]).abs().max() > 0.6:
            continue

        def pixel(point):
            homogeneous = scene["K"] @ (scene["viewmat"][:3, :3] @ point + scene["viewmat"][:3, 3])
            return homogeneous[:2] / homogeneous[2]

        jacobian = torch.autograd.functional.jacobian(pixel, scene["means"][i])
        axes = rotation_matrix(scene["quats"][i]) * scene["scales"][i]
        covariance = jacobian @ axes @ axes.T @ jacobian.T + 0.3 * torch.eye(2, dtype=torch.float64)
        a, b, c = projected.conics[i]
        conic = torch.stack([torch.stack([a, b]), torch.stack([b, c])])
        torch.testing.assert_close(conic @ covariance, torch.eye(2, dtype=torch.float64), atol=1e-10, rtol=0)
        torch.testing.assert_close(projected.means2d[i], pixel(scene["means"][i]))
        largest = torch.linalg.eigvalsh(covariance)[1]
        radius = (2 * math.log(255 * scene["opacities"][i]) * largest).sqrt()
        torch.testing.assert_close(projected.radii[i], radius)
        torch.testing.assert_close(projected.depths[i], camera[2])
        checked += 1
    assert checked > 15


def test_orthographic_projection_is_exact():
    scene = orthographic(make_scene(30, seed=4))
    projected = project(**{name: value for name, value in scene.items() if name != "background"})
    linear = torch.diag(scene["K"].diagonal()[:2]) @ scene["viewmat"][:2, :3]
    seen = scene["means"] @ scene["viewmat"][:3, :3].T + scene["viewmat"][:3, 3]
    drawn = projected.radii > 0
    assert drawn.sum() > 15
    pixels = seen[:, :2] * scene["K"].diagonal()[:2] + scene["K"][:2, 2]
    torch.testing.assert_close(projected.means2d[drawn], pixels[drawn])
    torch.testing.assert_close(projected.depths[drawn], seen[drawn, 2])
    for i in drawn.nonzero()[:, 0].tolist():
        axes = rotation_matrix(scene["quats"][i]) * scene["scales"][i]
        covariance = linear @ axes @ axes.T @ linear.T + 0.3 * torch.eye(2, dtype=torch.float64)
        a, b, c = projected.conics[i]
        conic = torch.stack([torch.stack([a, b]), torch.stack([b, c])])
        torch.testing.assert_close(conic @ covariance, torch.eye(2, dtype=torch.float64), atol=1e-10, rtol=0)


def test_orthographic_views_do_not_change_along_the_axis():
    scene = orthographic(make_scene(40))
    truth, _ = run(scene, "torch", torch.float64)
    scene["viewmat"] = scene["viewmat"].clone()
    scene["viewmat"][2, 3] += 2
    further, _ = run(scene, "torch", torch.float64)
    torch.testing.assert_close(further["channels_out"], truth["channels_out"])


def test_beyond_the_guard_band_the_shape_does_not_depend_on_the_place():
    scene = make_scene(1)
    scene["viewmat"] = torch.eye(4, dtype=torch.float64)
    arguments = [scene[k] for k in ("quats", "scales", "opacities", "channels", "viewmat", "K", "width", "height")]
    far_right = torch.tensor([[3.0, 0.0, 2.0]], dtype=torch.float64, requires_grad=True)
    project(far_right, *arguments).conics.sum().backward()
    assert far_right.grad[0, 0] == 0 and far_right.grad[0, 1] != 0 and far_right.grad[0, 2] != 0
    further = project(far_right.detach() + torch.tensor([1.0, 0, 0]), *arguments)
    torch.testing.assert_close(project(far_right, *arguments).conics.detach(), further.conics)


def test_gaussians_behind_the_near_plane_are_not_drawn():
    scene = make_scene(3)
    scene["viewmat"] = torch.eye(4, dtype=torch.float64)
    scene["means"] = torch.tensor([[0, 0, -1.0], [0, 0, 0.005], [0, 0, 1.0]], dtype=torch.float64)
    _, rendering = run(scene, "torch", torch.float64)
    assert rendering.radii[0] == 0 and rendering.radii[1] == 0 and rendering.radii[2] > 0


# -- reference ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 1, 40, 150])
def test_reference_blends_by_definition(n):
    scene = make_scene(n, channels=4, seed=n, size=0.5)
    if n > 2:
        scene["means"][1] = scene["means"][0]  # equal depths: the lower index is in front
    results, _ = run(scene, "torch", torch.float64)
    image, alpha, _ = blend_by_definition(scene)
    torch.testing.assert_close(results["channels_out"], image, atol=1e-12, rtol=0)
    torch.testing.assert_close(results["alpha"], alpha, atol=1e-12, rtol=0)
    assert n < 150 or (alpha > 0.9998).any()  # pixels that end early are among them


@pytest.mark.parametrize("seed, change", [(0, dict), (1, dict), (2, dict), (0, orthographic), (1, orthographic)])
def test_reference_gradients_by_finite_differences(seed, change):
    scene = change(make_scene(6, channels=2, width=14, height=9, seed=seed, size=0.5))
    scene["opacities"][0] = 1.0  # clamped at its centre
    inputs = [scene[name].clone().requires_grad_() for name in GRADIENTS]

    weights = torch.randn(4, 9, 14, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)

    def function(*values):
        rendering = rasterize(**{**scene, **dict(zip(GRADIENTS, values, strict=True))}, backend="torch")
        outputs = torch.cat([rendering.channels, rendering.alpha[..., None]], -1)
        return (weights * outputs).sum((1, 2, 3))

    assert torch.autograd.gradcheck(function, inputs, eps=1e-7, atol=1e-5, rtol=1e-4)


# -- kernels -----------------------------------------------------------------------------------------------------------


class TestCpu(KernelSuite):
    """The suite of all backends."""

    backend, gradients, scenes = "cpu", 1e-5, 8


@pytest.mark.parametrize("count", [150, pytest.param(2000, marks=pytest.mark.search)])
def test_kernels_agree_on_many_scenes(count):
    for number in range(count):
        scene = make_scene(8, channels=2, width=13, height=10, seed=number, size=0.4)
        truth, _ = run(scene, "torch", torch.float64)
        result, _ = run(scene, "cpu")
        errors = {key: relative_error(result[key], truth[key]) for key in truth}
        assert max(errors.values()) < 1e-5, (number, errors)


@pytest.mark.parametrize("target", build.host_targets(), ids=lambda t: f"v{t.level}")
def test_every_instruction_set_agrees(target, monkeypatch):
    if target.level > cpu_library.supported_level():
        pytest.skip(f"this processor has no x86-64-v{target.level}")
    monkeypatch.setitem(KERNELS, "cpu", CpuKernels(lambda: CpuLibrary(target.path)))
    for scene in clear_scenes(3, n=40, channels=5):
        truth, _ = run(scene, "torch", torch.float64)
        result, _ = run(scene, "cpu")
        assert max(relative_error(result[key], truth[key]) for key in truth) < 1e-5


def test_same_bits_for_any_number_of_threads():
    scene = make_scene(3000, channels=4, width=200, height=130, size=0.1)
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 3, 7, 1):
            torch.set_num_threads(threads)
            results.append(run(scene, "cpu")[0])
    finally:
        torch.set_num_threads(before)
    for result in results[1:]:
        # torch sums the projection's gradients itself; what the kernels give is compared
        for key in ("channels_out", "alpha", "means2d", "opacities", "channels", "background"):
            assert torch.equal(result[key], results[0][key]), key


def test_torch_in_float32_is_close_and_auto_takes_the_kernels():
    scene = next(clear_scenes(1, n=60))
    slow, fast, auto = (run(scene, backend)[0] for backend in ("torch", "cpu", "auto"))
    assert max(relative_error(slow[key], fast[key]) for key in fast) < 1e-4
    assert all(torch.equal(auto[key], fast[key]) for key in fast)


# -- contributions -----------------------------------------------------------------------------------------------------


def contributions_of(scene, backend, dtype, images=3, seed=5):
    generator = torch.Generator().manual_seed(seed)
    size = scene["height"], scene["width"]
    given = {
        "weights": torch.rand(*size, images, generator=generator, dtype=torch.float64),
        "image_gradient": torch.randn(*size, scene["channels"].shape[1], generator=generator, dtype=torch.float64),
    }
    tensors = {k: v.to(dtype) for k, v in (scene | given).items() if isinstance(v, torch.Tensor)}
    return contributions(**{**scene, **tensors}, backend=backend), given


def test_contributions_are_what_autograd_says():
    scene = make_scene(30, channels=2, width=20, height=13, size=0.5)
    scene["opacities"][0] = 1.0  # clamped at its centre
    result, given = contributions_of(scene, "torch", torch.float64)

    def image_of(opacities):  # by the opacity: dC/dg = o dC/dalpha and dC/do = g dC/dalpha
        return rasterize(**{**scene, "opacities": opacities}, backend="torch").channels

    jacobian = torch.autograd.functional.jacobian(image_of, scene["opacities"])  # (H, W, C, N)
    arguments = [
        scene[k] for k in ("means", "quats", "scales", "opacities", "channels", "viewmat", "K", "width", "height")
    ]
    seen = project(*arguments)
    rows, columns = (torch.arange(size, dtype=torch.float64) + 0.5 for size in (scene["height"], scene["width"]))
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    a, b, c = seen.conics.unbind(1)
    dx, dy = x[..., None] - seen.means2d[:, 0], y[..., None] - seen.means2d[:, 1]
    value = torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)  # g (H, W, N)
    change = jacobian * (scene["opacities"] / value)[:, :, None]
    change = torch.where(jacobian == 0, 0, change)
    torch.testing.assert_close(result.importance, change.square().sum((0, 1, 2)))
    along = (change * given["image_gradient"][..., None]).sum(2)
    torch.testing.assert_close(result.error, along.square().sum((0, 1)))

    channels = scene["channels"].new_zeros(30, 3).requires_grad_()
    image = rasterize(
        **{**scene, "channels": channels, "background": torch.zeros(3).double()}, backend="torch"
    ).channels
    (weighted,) = torch.autograd.grad((image * given["weights"]).sum(), channels)
    torch.testing.assert_close(result.weighted, weighted)


@pytest.mark.parametrize("channels, images", [(1, 1), (3, 0), (3, 9), (8, 17)])
def test_kernels_agree_on_contributions(channels, images):
    for scene in clear_scenes(3, n=60, channels=channels, width=45, height=35, size=0.4):
        truth, _ = contributions_of(scene, "torch", torch.float64, images)
        result, _ = contributions_of(scene, "cpu", torch.float32, images)
        assert result.weighted.shape == (60, images)
        for name in ("importance", "error") + (("weighted",) if images else ()):
            assert relative_error(getattr(result, name).double(), getattr(truth, name)) < 1e-5, name


def test_contributions_without_images_and_of_too_many_channels():
    scene = changed()
    result = contributions(**scene)
    assert result.weighted.shape == (5, 0) and (result.error == 0).all() and (result.importance > 0).any()
    with pytest.raises(ValueError, match="at most 8 channels"):
        contributions(**changed(channels=torch.zeros(5, 9).double(), background=torch.zeros(9).double()))
    with pytest.raises(ValueError, match=r"weights has shape \(3, 40, 1\)"):
        contributions(**scene, weights=torch.zeros(3, 40, 1).double())


# -- hard cases --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@pytest.mark.parametrize("case", HARD)
def test_hard_cases_are_finite_for_orthographic_cameras(case, backend):
    results, rendering = run(orthographic(HARD[case]), backend)
    assert all(value.isfinite().all() for value in results.values())
    assert " in " not in case or rendering.radii[1] == 0


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@pytest.mark.parametrize("case", HARD)
def test_hard_cases_give_finite_images_and_gradients(case, backend):
    results, rendering = run(HARD[case], backend)
    for key, value in results.items():
        assert value.isfinite().all(), key
    assert (rendering.alpha >= 0).all() and (rendering.alpha <= 1).all()
    assert rendering.channels.shape[:2] == (HARD[case]["height"], HARD[case]["width"])
    if " in " in case:  # the bad one is out, the others are drawn as if it were not there
        assert rendering.radii[1] == 0 and (rendering.radii[[0, 2, 3, 4]] > 0).any()
        assert all((results[name][1] == 0).all() for name in GRADIENTS[:-1])
        others = [0, 2, 3, 4]
        without = HARD[case] | {name: HARD[case][name][others] for name in GRADIENTS[:-1]}
        assert torch.equal(run(without, backend)[0]["channels_out"], results["channels_out"])


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@pytest.mark.parametrize("case", HARD)
def test_hard_cases_give_finite_contributions(case, backend):
    result, _ = contributions_of(HARD[case], backend, torch.float32)
    for value in (result.weighted, result.importance, result.error):
        assert value.isfinite().all() and (value >= 0).all()
        assert " in " not in case or (value[1] == 0).all()


@pytest.mark.parametrize("case", ["no Gaussian", "all behind the camera", "all off screen", "opacity 0"])
@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_nothing_visible_shows_the_background(case, backend):
    results, rendering = run(HARD[case], backend)
    torch.testing.assert_close(
        rendering.channels.detach(), HARD[case]["background"].float().expand_as(rendering.channels)
    )
    assert (rendering.alpha == 0).all() and (rendering.radii == 0).all()
    assert all((results[name] == 0).all() for name in GRADIENTS[:-1]) and (results["background"] != 0).all()


def test_needles_and_huge_gaussians_match_the_reference():
    for case in ("huge scales", "vanishing scales", "zero scales", "pancakes", "opacity 1", "thousands of equals"):
        truth, _ = run(HARD[case], "torch", torch.float64)
        result, _ = run(HARD[case], "cpu")
        assert relative_error(result["channels_out"], truth["channels_out"]) < 1e-4, case
        assert relative_error(result["alpha"], truth["alpha"]) < 1e-4, case


def test_too_many_pairs_are_refused_before_memory_is_taken(monkeypatch):
    monkeypatch.setattr(protocol, "MAX_PAIRS", 1000)
    run(changed(n=400), "cpu")
    with pytest.raises(InputError, match="too many or too large"):
        run(changed(n=600, scales=lambda s: s + 10), "cpu")


# -- arguments----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("quats", torch.zeros(5, 3), r"quats has shape \(5, 3\), expected \(5, 4\)"),
        ("opacities", torch.zeros(5, 1), "opacities has shape"),
        ("background", torch.zeros(4), "background has shape"),
        ("channels", torch.zeros(5, 3, dtype=torch.float64), "channels is torch.float64"),
        ("K", torch.eye(3, dtype=torch.int64), "K is torch.int64"),
        ("width", 0, "cannot render"),
        ("backend", "gpu", "none of auto, cpu, cuda, wgpu, torch"),
    ],
)
def test_wrong_arguments_are_named(name, value, message):
    scene = {k: v.float() if isinstance(v, torch.Tensor) else v for k, v in changed().items()}
    with pytest.raises(ValueError, match=message):
        rasterize(**{**scene, name: value})


def test_non_contiguous_tensors_are_fine():
    scene = next(clear_scenes(1, n=40))
    strided = dict(scene)
    for name in GRADIENTS:
        strided[name] = torch.stack([scene[name], scene[name]], -1)[..., 0]
    expected, result = run(scene, "cpu")[0], run(strided, "cpu")[0]
    assert all(torch.equal(expected[key], result[key]) for key in expected)


def test_without_kernels_torch_computes_after_one_warning(monkeypatch):
    scene = changed()
    expected, _ = run(scene, "torch")
    monkeypatch.setattr(cpu_library, "host_targets", lambda: [])
    monkeypatch.setitem(KERNELS, "cpu", CpuKernels())
    with pytest.warns(UserWarning, match="CPU kernels not loaded") as caught:
        result, _ = run(scene, "auto")
    assert len(caught) == 1 and all(torch.equal(result[key], expected[key]) for key in expected)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run(scene, "auto")
    with pytest.raises(InputError, match="cpu backend"):
        run(scene, "cpu")


def test_the_backends_are_those_of_the_settings():
    assert {"auto", *KERNELS} == set(BACKENDS)


def test_gradients_by_the_camera_are_those_of_the_reference():
    scene = next(clear_scenes(1, n=40))

    def gradients(backend, dtype):
        tensors = {k: v.to(dtype, copy=True) for k, v in scene.items() if isinstance(v, torch.Tensor)}
        camera = [tensors[name].requires_grad_() for name in ("viewmat", "K")]
        image = rasterize(**{**scene, **tensors}, backend=backend).channels
        return [gradient.double() for gradient in torch.autograd.grad(image.square().sum(), camera)]

    truth = gradients("torch", torch.float64)
    for value, expected in zip(gradients("cpu", torch.float32), truth, strict=True):
        assert (expected != 0).any() and relative_error(value, expected) < 1e-3


def test_build_compiles_once_and_clears_what_is_stale(monkeypatch, tmp_path):
    monkeypatch.setattr(build, "LIBRARIES", tmp_path / "lib")
    target = build.host_targets()[-1]
    (path,) = build.build([target])
    assert ctypes.CDLL(str(path)).tile_width() > 0
    stale = path.with_name("swag-linux-x64-v2-000000000000.so")
    stale.touch()
    written = path.stat().st_mtime_ns
    build.build([target])
    assert path.stat().st_mtime_ns == written and not stale.exists()
