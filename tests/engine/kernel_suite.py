"""What the kernels compute, stage by stage, against the reference in float64: one suite for C++, CUDA and WGSL.

A file of tests makes a subclass of `KernelSuite` for its backend; tests about one language alone stand beside it. Water
and lamp in WGSL are parts of a whole step: test_webgpu_step.py compares them with the reference.
"""

from typing import Any

import pytest
import torch

from swag_engine.evaluation.ssim import ssim
from swag_engine.gaussians.sh import evaluate_sh
from swag_engine.kernels.backends import KERNELS
from swag_engine.kernels.reference.projection import project
from swag_engine.rasterize.api import contributions
from swag_engine.training.losses import photometric
from swag_engine.training.optimizer import EPS, adam_step
from swag_engine.water.medium import open_water, through_water
from tests.engine.raster_scenes import (
    GRADIENTS,
    HARD,
    changed,
    clear_scenes,
    make_scene,
    orthographic,
    relative_error,
    run,
)
from tests.engine.water_scenes import CAMERA, gain_and_gradients, make_water


class KernelSuite:
    """Tests of a backend.

    Attributes:
        backend: Its name.
        device: Where its tensors are.
        gradients: Largest error of a gradient, as a fraction of the largest gradient.
        scenes: Scenes of a test.
        small_scenes: Scenes of the test with many small ones.
    """

    backend = ""
    device = "cpu"
    gradients = 1e-4
    scenes = 3
    small_scenes = 8

    def run(self, scene):
        """As raster_scenes.run, by the backend."""
        return run(scene, self.backend, device=self.device)

    def check(self, scene, image=1e-5):
        """Compare colors, alpha and every gradient with the reference."""
        truth, _ = run(scene, "torch", torch.float64)
        result, _ = self.run(scene)
        errors = {key: relative_error(result[key], truth[key]) for key in truth}
        assert max(errors["channels_out"], errors["alpha"]) < image, errors
        assert max(errors.values()) < self.gradients, errors

    def both(self, compute):
        """Return what `compute(backend, dtype, device)` gives by the reference in float64, and by the backend."""
        truth = compute("torch", torch.float64, "cpu")
        result = compute(self.backend, torch.float32, self.device)
        return [[value.detach().double().cpu() for value in values] for values in (truth, result)]

    # -- projection and blending ---------------------------------------------------------------------------------------

    @pytest.mark.parametrize("change", [dict, orthographic])
    def test_projection_is_that_of_the_reference(self, change):
        """Centres, shapes, depths and radii."""
        scene = next(clear_scenes(1, change, n=50, width=47, height=35))
        names = "means", "quats", "scales", "opacities", "channels", "viewmat", "K"
        size = scene["width"], scene["height"], scene.get("kind", "perspective")
        truth = project(*[scene[name] for name in names], *size)  # type: ignore[call-arg]
        tensors = (scene[name].to(self.device, torch.float32) for name in names)
        got = KERNELS[self.backend].project(*tensors, *size)  # type: ignore[call-arg]
        drawn = truth.radii > 0
        assert drawn.sum() > 20 and torch.equal(got.radii.cpu() > 0, drawn)
        for name in ("means2d", "conics", "depths", "radii"):
            value, expected = getattr(got, name).detach().double().cpu()[drawn], getattr(truth, name)[drawn]
            assert relative_error(value, expected) < 1e-5, name

    @pytest.mark.parametrize("channels", [1, 3, 4, 7, 11])
    def test_images_and_gradients_are_those_of_the_reference(self, channels):
        for number, scene in enumerate(clear_scenes(self.scenes, n=50, channels=channels, width=47, height=35)):
            scene["width"] = 47 - (11 if self.scenes < 4 else 5) * number  # partial tiles
            self.check(scene)

    def test_orthographic_cameras(self):
        for number, scene in enumerate(clear_scenes(self.scenes, orthographic, n=50, width=47, height=35)):
            scene["width"] = 47 - (11 if self.scenes < 4 else 5) * number
            self.check(scene)

    def test_many_small_scenes(self):
        for number in range(self.small_scenes):
            self.check(make_scene(8, channels=2, width=19, height=18, seed=number, size=0.4))

    def test_pixels_that_end_early(self):
        for scene in clear_scenes(2, n=120, width=33, height=35, size=0.5):
            self.check(scene)

    def test_many_gaussians_on_a_tile(self):
        scene = make_scene(400, width=16, height=16, size=0.6)
        scene["opacities"] *= 0.02
        self.check(scene)

    def test_beyond_the_guard_band_and_degenerate_shapes(self):
        scene = changed(n=8, means=lambda m: m * torch.tensor([8.0, 5.0, 1.0]), scales=lambda s: s * 4)
        beside = (scene["means"][:, :2] / scene["means"][:, 2:]).abs() > torch.tensor([0.9, 0.7])
        assert beside.any(0).all() and not beside.all(1).any()
        scene["quats"][:2] *= 1e-8
        scene["quats"][2] = 0
        scene["scales"][3:5, 0] = 1e-7
        self.check(scene)

    def test_small_and_far_gaussians(self):
        scene = make_scene(50, size=0.01)
        self.check(scene)
        shift = torch.tensor([1000.0, -2000.0, 500.0], dtype=torch.float64)
        scene["means"] = (scene["means"] + shift).float().double()
        scene["viewmat"][:3, 3] = (scene["viewmat"][:3, 3] - scene["viewmat"][:3, :3] @ shift).float().double()
        self.check(scene)

    @pytest.mark.parametrize("case", HARD)
    def test_hard_cases_give_finite_images_and_gradients(self, case):
        results, rendering = self.run(HARD[case])
        for key, value in results.items():
            assert value.isfinite().all(), key
        assert (rendering.alpha >= 0).all() and (rendering.alpha <= 1).all()
        assert rendering.channels.shape[:2] == (HARD[case]["height"], HARD[case]["width"])
        found = self.contributions(HARD[case], 1, self.backend, torch.float32, self.device)
        assert all(value.isfinite().all() and (value >= 0).all() for value in found)
        if " in " in case:  # the bad one is out, the others are drawn as if it were not there
            assert rendering.radii[1] == 0 and (rendering.radii[[0, 2, 3, 4]] > 0).any()
            assert all((results[name][1] == 0).all() for name in GRADIENTS[:-1])
            others = [0, 2, 3, 4]
            without = HARD[case] | {name: HARD[case][name][others] for name in GRADIENTS[:-1]}
            assert torch.equal(self.run(without)[0]["channels_out"], results["channels_out"])

    @pytest.mark.parametrize(
        "case", ["huge scales", "vanishing scales", "pancakes", "opacity 1", "thousands of equals", "huge quaternions"]
    )
    def test_hard_cases_match_the_reference(self, case):
        truth, _ = run(HARD[case], "torch", torch.float64)
        result, _ = self.run(HARD[case])
        for key in ("channels_out", "alpha"):
            assert relative_error(result[key], truth[key]) < 1e-4, key
        assert case != "huge scales" or (result["scales"] == 0).all()

    # -- sums of contributions -----------------------------------------------------------------------------------------

    def contributions(self, scene, images, backend, dtype, device):
        """Return weighted sums, importance and error of random images."""
        generator, size = torch.Generator().manual_seed(5), (scene["height"], scene["width"])
        given = {
            "weights": torch.rand(*size, images, generator=generator, dtype=torch.float64),
            "image_gradient": torch.randn(*size, scene["channels"].shape[1], generator=generator, dtype=torch.float64),
        }
        moved: dict[str, Any] = {
            k: v.to(device, dtype) if isinstance(v, torch.Tensor) else v for k, v in (scene | given).items()
        }
        found = contributions(**moved, backend=backend)
        return [found.weighted, found.importance, found.error]

    @pytest.mark.parametrize("channels, images", [(1, 0), (3, 3), (8, 14)])
    def test_contributions_are_those_of_the_reference(self, channels, images):
        for scene in clear_scenes(2, n=60, channels=channels, width=45, height=35, size=0.4):
            truth, result = self.both(lambda *by, scene=scene: self.contributions(scene, images, *by))
            for value, expected in zip(result, truth, strict=True):
                assert value.shape == expected.shape
                assert not expected.numel() or relative_error(value, expected) < 1e-5

    # -- colors, water, loss, optimiser --------------------------------------------------------------------------------

    @pytest.mark.parametrize("degree, stored", [(0, 0), (0, 3), (1, 1), (2, 3), (3, 3)])
    def test_colors_by_direction_are_those_of_the_reference(self, degree, stored):
        generator = torch.Generator().manual_seed(degree)
        sh0, shN, directions, weights = (
            torch.randn(300, *shape, generator=generator, dtype=torch.float64)
            for shape in ((1, 3), ((stored + 1) ** 2 - 1, 3), (3,), (3,))
        )
        directions /= directions.norm(dim=1, keepdim=True)

        def colors_and_gradients(backend, dtype, device):
            inputs = [tensor.to(device, dtype, copy=True).requires_grad_() for tensor in (sh0, shN)]
            colors = evaluate_sh(inputs[0], inputs[1], directions.to(device, dtype), degree, backend)
            (colors * weights.to(colors)).sum().backward()
            return colors, *(tensor.grad for tensor in inputs)

        truth, result = self.both(colors_and_gradients)
        assert (truth[0] == 0).any() and (truth[0] > 0).any()
        for value, expected in zip(result, truth, strict=True):
            torch.testing.assert_close(value, expected, atol=2e-6, rtol=1e-5)

    @pytest.mark.parametrize("light", ["linear", "srgb"])
    @pytest.mark.parametrize("degree", [0, 1, 2])
    def test_water_is_that_of_the_reference(self, degree, light):
        def seen_and_gradients(backend, dtype, device):
            colors, offsets, medium = make_water(400, light, dtype=dtype)
            medium, leaves = medium.to(torch.device(device)), [t.to(device).requires_grad_() for t in (colors, offsets)]
            parameters = [t.requires_grad_() for t in medium.parameters().values()]
            viewmat, K = (t.to(device, dtype) for t in CAMERA)
            seen = through_water(leaves[0], leaves[1], medium, degree, backend=backend)
            behind = open_water(medium, viewmat, K, 22, 16, degree, backend=backend)
            weights = (torch.randn(t.shape, generator=torch.Generator().manual_seed(3)).to(t) for t in (seen, behind))
            totals = [(t * w).sum() for t, w in zip((seen, behind), weights, strict=True)]
            return seen, behind, *torch.autograd.grad(totals, [*leaves, *parameters])

        truth, result = self.both(seen_and_gradients)
        for value, expected in zip(result, truth, strict=True):
            assert relative_error(value, expected) < 2e-5

    @pytest.mark.parametrize("shape", [(1,), (3,), (45, 17, 1)])
    def test_gains_are_those_of_the_reference(self, shape):
        truth, result = self.both(lambda *by: gain_and_gradients(shape, *by))
        for value, expected in zip(result, truth, strict=True):
            torch.testing.assert_close(value, expected, atol=1e-5, rtol=1e-5)

    @pytest.mark.parametrize("height, width", [(1, 1), (7, 40), (45, 35)])
    def test_l1_and_ssim_are_those_of_the_reference(self, height, width):
        generator = torch.Generator().manual_seed(height)
        target = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
        image = (target + 0.2 * torch.randn(height, width, 3, generator=generator, dtype=torch.float64)).clamp(0, 1)
        image[2:3] = target[2:3]  # |image - target| has no slope there

        def losses(backend, dtype, device):
            a, b = image.to(device, dtype, copy=True).requires_grad_(), target.to(device, dtype)
            photometric(a, b, None, 0.7, 0.3, backend=backend).backward()
            return photometric(a, b, None, 1.0, 1e-30, backend=backend), ssim(a, b, backend), a.grad

        truth, result = self.both(losses)
        for value, expected in zip(result, truth, strict=True):
            assert relative_error(value, expected) < 1e-5

    def adam(self, parameter, gradients, backend, epsilon):
        """Make a step of .1 with each gradient in place; return the parameter and its moments."""
        moments = torch.zeros_like(parameter), torch.zeros_like(parameter)
        for number, gradient in enumerate(gradients):
            adam_step(parameter, gradient, *moments, 0.1, number + 1, backend, epsilon)
        return parameter, *moments

    @pytest.mark.parametrize("epsilon", [EPS, 0.5])
    def test_adam_is_that_of_the_reference(self, epsilon):
        values = torch.randn(6, 40, 5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

        def trajectory(backend, dtype, device):
            return self.adam(values[0].to(device, dtype, copy=True), values[1:].to(device, dtype), backend, epsilon)

        truth, result = self.both(trajectory)
        for value, expected in zip(result, truth, strict=True):
            torch.testing.assert_close(value, expected, atol=2e-6, rtol=1e-5)
