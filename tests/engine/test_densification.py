"""Densification: splitting by the gradient on screen, relocation, noise and regularisation of 3DGS-MCMC, and removal
in front of cameras."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.gaussians.densify import (
    PER_GAUSSIAN,
    DensificationStatistics,
    McmcStrategy,
    SplitStrategy,
    random_of,
    rotation_matrices,
    share_opacity,
    split_along_longest_axis,
)
from swag_engine.gaussians.sizes import nearest_offsets
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import load_scene
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.inputs import load_inputs
from swag_engine.training.schedule import STANDARD
from swag_engine.training.trainer import Trainer
from tests.scenes.clouds import make_cloud
from tests.scenes.runs import train_with


def test_a_split_keeps_mass_mean_and_variance():
    cloud = make_cloud(50)
    index = torch.arange(50)
    children = [split_along_longest_axis(cloud, index, sign) for sign in (1.0, -1.0)]
    mass, first, second = torch.zeros(50), torch.zeros(50, 3), torch.zeros(50, 3, 3)
    for child in children:
        part = GaussianCloud(**child, background=cloud.background)
        weight = part.opacities * part.scales.prod(dim=-1)
        mass = mass + weight
        first = first + weight[:, None] * part.means
        offset = part.means - cloud.means
        second = second + weight[:, None, None] * (covariance(part) + offset[:, :, None] * offset[:, None, :])
    torch.testing.assert_close(mass, cloud.opacities * cloud.scales.prod(dim=-1))
    torch.testing.assert_close(first / mass[:, None], cloud.means)
    torch.testing.assert_close(second / mass[:, None, None], covariance(cloud))


def covariance(cloud):
    axes = rotation_matrices(cloud.quats) * cloud.scales[:, None, :]
    return axes @ axes.transpose(1, 2)


def test_large_gradients_are_split_and_transparent_gaussians_removed():
    cloud = make_cloud(10)
    cloud.opacity_logits[3] = -9.0
    statistics = DensificationStatistics(torch.zeros(10), torch.ones(10))
    statistics.gradient[[2, 7]] = torch.tensor([1.0, 2.0])
    densified, source = SplitStrategy().densify(cloud, statistics, 10, 5.0, random_of(0, 0))
    assert len(densified) == 10  # 9 remain and one more fits: the larger of the two gradients is split
    assert 3 not in source and 7 not in source and (source == -1).sum() == 2
    kept = source[source >= 0]
    torch.testing.assert_close(densified.means[: len(kept)], cloud.means[kept])


def test_a_transparent_cloud_is_not_changed():
    cloud = make_cloud(4)
    cloud.opacity_logits[:] = -20.0
    densified, source = SplitStrategy().densify(
        cloud, DensificationStatistics.zeros(4, cloud.means.device), 100, 5.0, random_of(0, 0)
    )
    assert len(densified) == 4 and torch.equal(source, torch.arange(4))


def statistics_of(gradients):
    """Statistics of one view with these gradients on screen."""
    return DensificationStatistics(torch.tensor(gradients), torch.ones(len(gradients)))


def test_weights_multiply_the_scores():
    cloud, statistics = make_cloud(5), statistics_of([1.0, 2.0, 3.0, 4.0, 5.0])
    same, source = SplitStrategy().densify(cloud, statistics, 6, 5.0, random_of(0, 0), weight=torch.ones(5))
    plain, expected = SplitStrategy().densify(cloud, statistics, 6, 5.0, random_of(0, 0))
    assert torch.equal(source, expected) and torch.equal(same.means, plain.means)
    _, source = SplitStrategy().densify(
        cloud, statistics, 6, 5.0, random_of(0, 0), weight=torch.tensor([9.0, 1, 1, 1, 1])
    )
    assert source.tolist() == [1, 2, 3, 4, -1, -1]


def test_splitting_adds_no_noise_and_no_loss():
    cloud = make_cloud(5)
    before = {name: tensor.clone() for name, tensor in cloud.parameters().items()}
    SplitStrategy().perturb(cloud, 1.0, 1.0, random_of(0, 0))
    assert SplitStrategy().regularisation(cloud, 1.0) is None
    assert all(torch.equal(tensor, before[name]) for name, tensor in cloud.parameters().items())


@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9, 0.999])
@pytest.mark.parametrize("count", [1, 2, 3, 10, 51])
def test_shared_opacity_keeps_the_centre_and_the_integral(opacity, count):
    shared, shrink = share_opacity(torch.tensor([opacity], dtype=torch.float64), torch.tensor([count]))
    x = torch.linspace(-8, 8, 4001, dtype=torch.float64)
    profile = 1 - (1 - shared * torch.exp(-0.5 * (x / shrink) ** 2)) ** count
    assert profile.max().item() == pytest.approx(opacity, rel=1e-9)
    assert torch.trapezoid(profile, x).item() == pytest.approx(opacity * (2 * np.pi) ** 0.5, rel=1e-9)


def test_an_opacity_shared_by_two_is_that_of_the_paper():
    o = torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)
    shared, shrink = share_opacity(o, torch.full((3,), 2))
    new = 1 - (1 - o) ** 0.5
    torch.testing.assert_close(shared, new)
    # The double sum of the paper for N = 2: i = 1 gives o', i = 2 gives o' - o'^2 / sqrt 2.
    torch.testing.assert_close(shrink, o / (new + new - new**2 / 2**0.5))


def test_dead_gaussians_are_relocated_and_the_number_rises_to_the_budget():
    cloud = make_cloud(40)
    cloud.opacity_logits[:10] = -9.0
    cloud.opacity_logits[10] = torch.nan
    cloud.sh0[11] = torch.inf
    densified, source = McmcStrategy().densify(
        cloud, DensificationStatistics.zeros(40, cloud.means.device), 50, 5.0, random_of(0, 1)
    )
    assert len(densified) == len(source) == 50
    assert all(getattr(densified, name).isfinite().all() for name in PER_GAUSSIAN)
    assert not set(range(12)) & set(source.tolist())
    kept = source >= 0
    for name in PER_GAUSSIAN:
        torch.testing.assert_close(getattr(densified, name)[kept], getattr(cloud, name)[source[kept]])
    # The first 28 are the living in their order; the relocated ones follow, exactly at the places of living ones.
    where = (densified.means[28:, None] == densified.means[None, :28]).all(-1)
    assert (where.sum(1) == 1).all()
    parents = where.any(0)
    assert torch.equal(parents, source[:28] < 0)
    alone = 1 - cloud.opacities[12:]
    together = (1 - densified.opacities[:28]) * torch.stack(
        [(1 - densified.opacities[28:][where[:, i]]).prod() for i in range(28)]
    )
    torch.testing.assert_close(together, alone)
    _, shrink = share_opacity(cloud.opacities[12:], where.sum(0) + 1)
    torch.testing.assert_close(densified.scales[:28], cloud.scales[12:] * shrink[:, None])


def test_relocation_changes_the_image_little():
    camera = Camera("a", 96, 64, 80.0, 80.0, 48.0, 32.0, np.eye(4))
    cloud = make_cloud(60)
    densified, _ = McmcStrategy().densify(
        cloud, DensificationStatistics.zeros(60, cloud.means.device), 90, 5.0, random_of(0, 1)
    )
    copies, _ = McmcStrategy().densify(
        cloud, DensificationStatistics.zeros(60, cloud.means.device), 90, 5.0, random_of(0, 1)
    )
    same = (copies.means[60:, None] == copies.means[None, :60]).all(-1).int().argmax(1)
    for name in ("opacity_logits", "log_scales"):
        original = getattr(cloud, name)
        setattr(copies, name, torch.cat([original, original[same]]))
    before = render(cloud, camera).color
    changes = [(render(c, camera).color - before).abs().mean() for c in (densified, copies)]
    assert changes[0] < 0.3 * changes[1] and changes[0] * 255 < 1


def test_living_gaussians_are_drawn_by_opacity_and_weight():
    cloud = make_cloud(3)
    cloud.opacity_logits[:] = torch.logit(torch.tensor([0.1, 0.3, 0.6]))
    statistics, budget = DensificationStatistics.zeros(3, cloud.means.device), 4003

    def drawn(weight):
        densified, _ = McmcStrategy().densify(cloud, statistics, budget, 5.0, random_of(0, 0), weight)
        return [(densified.means[3:] == mean).all(-1).double().mean().item() for mean in cloud.means]

    np.testing.assert_allclose(drawn(None), [0.1, 0.3, 0.6], atol=0.03)
    np.testing.assert_allclose(drawn(torch.tensor([6.0, 0.0, 1.0])), [0.5, 0, 0.5], atol=0.03)


def test_random_numbers_depend_on_seed_and_iteration_alone():
    def numbers(seed, iteration):
        return torch.rand(4, generator=random_of(seed, iteration)).tolist()

    assert numbers(1, 2) == numbers(1, 2)
    assert len({tuple(numbers(seed, iteration)) for seed in range(4) for iteration in range(4)}) == 16


@pytest.mark.parametrize("strategy", [SplitStrategy(), McmcStrategy()])
@pytest.mark.parametrize("n", [0, 1, 7])
@pytest.mark.parametrize("opacity", [-20.0, 0.0, 40.0])
def test_small_and_extreme_clouds_stay_finite(strategy, n, opacity):
    cloud = make_cloud(n, dtype=torch.float32)
    cloud.opacity_logits[:] = opacity
    statistics = DensificationStatistics(torch.ones(n), torch.ones(n))
    densified, source = strategy.densify(cloud, statistics, 200, 5.0, random_of(0, 0))
    assert len(densified) == len(source) <= 200
    assert n <= len(densified)
    strategy.perturb(densified, 1e-3, 5.0, random_of(0, 0))
    assert all(getattr(densified, name).isfinite().all() for name in PER_GAUSSIAN)


def test_noise_has_the_covariance_of_faint_gaussians():
    n = 4000
    cloud = make_cloud(n)
    cloud.quats[:] = torch.tensor([0.8, 0.1, -0.5, 0.3], dtype=torch.float64)
    cloud.log_scales[:] = torch.tensor([0.2, 0.1, 0.02], dtype=torch.float64).log()
    cloud.opacity_logits[: n // 2] = torch.logit(torch.tensor(0.015))
    cloud.opacity_logits[n // 2 :] = 3.0
    before = cloud.means.clone()
    McmcStrategy().perturb(cloud, 1e-3, 1.0, random_of(0, 5))
    moved = cloud.means - before
    assert torch.equal(moved[n // 2 :], torch.zeros_like(moved[n // 2 :]))
    axes = rotation_matrices(cloud.quats[:1])[0]
    deviations = (moved[: n // 2] @ axes).std(dim=0)
    expected = 1e-3 * 5e5 / (1 + np.e) * torch.tensor([0.04, 0.01, 0.0004], dtype=torch.float64)
    torch.testing.assert_close(deviations, expected, rtol=0.06, atol=0)


def test_noise_and_loss_do_not_depend_on_the_scene_s_unit():
    moves, losses = [], []
    for unit in (1.0, 100.0):
        cloud = make_cloud(20)
        cloud.opacity_logits[:] = -5.0
        cloud.means *= unit
        cloud.log_scales += np.log(unit)
        before = cloud.means.clone()
        losses.append(McmcStrategy().regularisation(cloud, 3 * unit))
        McmcStrategy().perturb(cloud, 1e-3 * unit, 3 * unit, random_of(0, 5))
        moves.append((cloud.means - before) / unit)
    torch.testing.assert_close(*moves)
    torch.testing.assert_close(*losses)
    assert moves[0].abs().max() > 0


def test_the_loss_makes_gaussians_fainter_and_smaller():
    cloud = make_cloud(6)
    for tensor in (cloud.opacity_logits, cloud.log_scales):
        tensor.requires_grad_()
    McmcStrategy().regularisation(cloud, 2.0).backward()
    assert (cloud.opacity_logits.grad > 0).all() and (cloud.log_scales.grad > 0).all()


def moved(trainer: Trainer, count: int, depth: float) -> Trainer:
    """Put the first Gaussians of a trainer on the axis of the first camera, and return it.

    `depth` is in least ranges: behind the camera where it is negative, and then no image of the tiny scene sees them.
    """
    inputs = trainer.inputs
    pose = torch.from_numpy(inputs.training[0].camera.world_to_camera).float()
    place = -pose[:3, :3].T @ pose[:3, 3] + depth * inputs.least_range * pose[2, :3]
    trainer.state.cloud.means.data[:count] = place
    return trainer


def ready_to_limit(scene, folder):
    """Train the tiny scene for 40 iterations and return its trainer when Gaussians are next looked at."""
    trainers: list[Trainer] = []
    train_with(scene, folder, TrainSettings(iterations=40, width=64, max_gaussians=400), trainers.append)
    state = trainers[0].state
    state.iteration, state.clock.fraction = 2 * trainers[0].inputs.schedule.densify_every, 0.5
    return trainers[0]


def test_gaussians_before_all_surfaces_that_no_image_sees_are_removed(tiny_scene, tmp_path):
    runs: list[Trainer] = []
    settings = TrainSettings(iterations=60, width=64, max_gaussians=400)
    train_with(tiny_scene, tmp_path / "run", settings, lambda trainer: runs.append(moved(trainer, 20, -0.1)))
    inputs, cloud = runs[0].inputs, runs[0].state.cloud
    cameras = [image.camera for image in inputs.training]
    assert nearest_offsets(cloud.means, cameras).norm(dim=1).min() >= inputs.least_range
    assert len(cloud) > 250


@pytest.mark.parametrize("depth", [0.5, -1.01])
def test_gaussians_that_an_image_sees_or_that_are_as_far_as_surfaces_stay(tiny_scene, tmp_path, depth):
    trainer = ready_to_limit(tiny_scene, tmp_path / "run")
    before = len(trainer.state.cloud)
    moved(trainer, 20, depth).densification._enforce_limits(trainer.state)
    assert len(trainer.state.cloud) == before
    points = torch.from_numpy(trainer.inputs.scene.points.positions)
    ranges = nearest_offsets(points, [image.camera for image in trainer.inputs.training]).norm(dim=1)
    assert 0.8 * ranges.min() < trainer.inputs.least_range < ranges.min()


def test_moments_follow_and_a_cloud_that_would_vanish_stays(tiny_scene, tmp_path):
    trainer = ready_to_limit(tiny_scene, tmp_path / "run")
    state = trainer.state
    before, moments = len(state.cloud), state.optimizer.moments["means"][0].clone()
    moved(trainer, 20, -0.1).densification._enforce_limits(state)
    assert len(state.cloud) == before - 20 and state.optimizer.moments["means"][0].equal(moments[20:])
    moved(trainer, before, -0.1).densification._enforce_limits(state)
    assert len(state.cloud) == before - 20


def test_a_wrong_point_near_a_camera_does_not_change_how_near_surfaces_may_be(tiny_scene):
    scene, settings = load_scene(tiny_scene), TrainSettings(width=64)
    right = load_inputs(scene, settings, STANDARD, lambda event: None)
    positions = scene.points.positions.copy()
    positions[0] = right.training[0].camera.centre
    wrong = replace(right, scene=replace(scene, points=replace(scene.points, positions=positions)))
    assert wrong.least_range == pytest.approx(right.least_range, rel=0.02)
    none = replace(scene.points, positions=positions[:0])
    assert replace(right, scene=replace(scene, points=none)).least_range == 0
