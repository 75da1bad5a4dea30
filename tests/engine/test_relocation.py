"""Relocation: the scores of Gaussians, which of them are relocated, and what that does to the image."""

from pathlib import Path

import numpy as np
import pytest
import torch

from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.gaussians.densify import PER_GAUSSIAN, share_opacity
from swag_engine.gaussians.init import gaussians_from_points
from swag_engine.gaussians.relocate import CLONE_OFFSET, parents_and_clones, relocate
from swag_engine.rendering import importance
from swag_engine.rendering.importance import scores
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images
from swag_engine.training.optimizer import Optimizer
from swag_engine.water.medium import Medium
from swag_engine.water.network import WaterNetwork
from tests.scenes.clouds import make_cloud

REEF = Path(__file__).resolve().parents[1] / "scenes" / "reef_wreck"


@pytest.fixture(scope="module")
def reef():
    """A cloud trained a little on the demo scene, its cameras, and the loss of each image."""
    scene = load_scene(REEF)
    images = load_images(scene, scene.views[::4], 160)
    cloud = gaussians_from_points(scene.points, 6000, 0, 0, np.full(3, 0.4))
    targets = [torch.from_numpy(image.pixels).float() / 255 for image in images]
    views = [
        (image.camera, lambda c, t=target: (c - t).abs().mean()) for image, target in zip(images, targets, strict=True)
    ]
    optimizer = Optimizer(cloud, SceneEffects())
    rates = {"means": 1e-3, "quats": 2e-3, "log_scales": 1e-2, "opacity_logits": 5e-2, "sh0": 1e-2, "background": 1e-2}
    for step in range(200):
        camera, loss = views[step % len(views)]
        loss(render(optimizer.cloud, camera, 0).color).backward()
        optimizer.step(rates)
    trained = GaussianCloud(**{name: t.detach() for name, t in optimizer.cloud.parameters().items()})
    return trained, views


@pytest.fixture(scope="module")
def reef_scores(reef):
    cloud, views = reef
    return scores(cloud, views, 0)


def change(reef, cloud):
    """Absolute change of all images of the reef, in 1/255."""
    before, views = reef
    pairs = [(render(cloud, camera, 0).color, render(before, camera, 0).color) for camera, _ in views]
    return 255 * torch.cat([(a - b).abs().reshape(-1) for a, b in pairs])


def with_clones(cloud, parents, identical=False, **how):
    """The cloud with Gaussians `parents` (M,) cloned and none removed."""
    values = {name: getattr(cloud, name).clone() for name in PER_GAUSSIAN}
    chosen = GaussianCloud(**{name: t[parents] for name, t in values.items()}, background=cloud.background)
    kept, clones = (chosen.parameters(), chosen.parameters()) if identical else parents_and_clones(chosen, **how)
    for name, t in values.items():
        t[parents] = kept[name]
    return GaussianCloud(
        **{name: torch.cat([t, clones[name]]) for name, t in values.items()}, background=cloud.background
    )


@pytest.mark.parametrize("identical", [False, True])
@pytest.mark.parametrize("n", [0, 1, 9, 10, 57])
def test_the_number_stays_and_scores_decide(n, identical):
    cloud = make_cloud(n)
    S, E = torch.arange(n).double(), torch.arange(n).double() % 7  # ties in E: the first ones are cloned
    before = {name: t.clone() for name, t in cloud.parameters().items()}
    moved, source = relocate(cloud, S, E, 0.1, identical)
    count = n // 10
    assert len(moved) == len(source) == n
    assert all(torch.equal(t, before[name]) for name, t in cloud.parameters().items())
    survivors = torch.arange(count, n)
    parents = [i for i in survivors.tolist() if i % 7 == 6][:count]
    expected = [-1 if i in parents else i for i in survivors.tolist()] + [-1] * count
    assert source.tolist() == expected
    kept = source >= 0
    for name in PER_GAUSSIAN:
        assert torch.equal(getattr(moved, name)[kept], before[name][source[kept]])
        if identical:
            originals = torch.cat([survivors, torch.tensor(parents, dtype=torch.long)])
            assert torch.equal(getattr(moved, name), before[name][originals])
    if not identical and count:
        chosen = GaussianCloud(**{name: before[name][parents] for name in PER_GAUSSIAN}, background=cloud.background)
        for name in PER_GAUSSIAN:
            pair = torch.cat([part[name] for part in parents_and_clones(chosen)])
            assert torch.equal(getattr(moved, name)[source < 0], pair)


def test_equal_halves_are_those_of_mcmc():
    cloud = make_cloud(20)
    parents, clones = parents_and_clones(cloud, opacity=1.0, offset=0.0)
    opacity, shrink = share_opacity(cloud.opacities, torch.full((20,), 2))
    for part in (parents, clones):
        torch.testing.assert_close(part["opacity_logits"].sigmoid(), opacity)
        torch.testing.assert_close(part["log_scales"].exp(), cloud.scales * shrink[:, None])
        torch.testing.assert_close(part["means"], cloud.means)


def test_a_clone_and_its_parent_are_as_opaque_as_before():
    cloud = make_cloud(50)
    parents, clones = parents_and_clones(cloud)
    together = 1 - (1 - parents["opacity_logits"].sigmoid()) * (1 - clones["opacity_logits"].sigmoid())
    torch.testing.assert_close(together, cloud.opacities)
    assert torch.equal(parents["means"], cloud.means)
    offset = (clones["means"] - cloud.means).norm(dim=1)
    torch.testing.assert_close(offset, CLONE_OFFSET * cloud.scales.amax(1))
    for name in ("quats", "sh0", "shN"):
        assert torch.equal(clones[name], getattr(cloud, name))
    for value in (-30.0, 30.0):
        cloud.opacity_logits[:] = value
        assert all(t.isfinite().all() for part in parents_and_clones(cloud) for t in part.values())


def test_clones_hardly_change_the_image(reef, reef_scores):
    """Each clone alone changes no pixel by 1/255, all of a relocation change at most one in a thousand."""
    cloud, _ = reef
    parents = torch.sort(reef_scores[1], descending=True, stable=True).indices[: len(cloud) // 10]
    ours, halves, copies = (
        change(reef, with_clones(cloud, parents, **how))
        for how in ({}, {"opacity": 1.0, "offset": 0.0}, {"identical": True})
    )
    assert ours.quantile(0.999) < 1 and ours.max() < 3 and ours.mean() < 0.2
    assert halves.mean() > 4 * ours.mean() and copies.mean() > 20 * ours.mean()
    alone = [change(reef, with_clones(cloud, parent[None])).max() for parent in parents[:: len(parents) // 20]]
    assert len(alone) >= 20 and 0.1 < max(alone) < 1


def test_removing_the_least_important_hardly_changes_the_image(reef, reef_scores):
    cloud, _ = reef
    lowest = torch.sort(reef_scores[0], stable=True).indices
    random_order = torch.randperm(len(cloud), generator=torch.Generator().manual_seed(0))
    changes = []
    for order in (lowest, random_order):
        rest = {name: getattr(cloud, name)[order[len(cloud) // 10 :]] for name in PER_GAUSSIAN}
        changes.append(change(reef, GaussianCloud(**rest, background=cloud.background)).mean())
    assert changes[0] < 0.3 and changes[0] < 0.15 * changes[1]


def test_clones_are_where_the_error_is(reef):
    """Where the loss is of one half of the image, clones are in that half."""
    cloud, views = reef
    camera = views[0][0]
    half = camera.width // 2
    S, E = scores(cloud, [(camera, lambda color: (color[:, :half] - 0.5).square().mean())], 0)
    _, source = relocate(cloud, S, E)
    survivors = torch.sort(torch.sort(S, stable=True).indices[len(cloud) // 10 :]).values
    parents = survivors[source[: len(survivors)] < 0]
    x = render(cloud, camera, 0).rendering.means2d[parents, 0]
    assert len(parents) == len(cloud) // 10 and (x < half).double().mean() > 0.95
    assert (S > 0).sum() > (E > 0).sum() > 0


@pytest.mark.parametrize("water", [None, "linear", "srgb"])
def test_scores_are_the_changes_of_the_image(water):
    """Against autograd: for Gaussians wider than the image g is 1, so dC/dg is o dC/do."""
    cloud = make_cloud(4)
    cloud.means[:] = torch.tensor([[0.0, 0, 4], [0, 0, 5], [0, 0, 6], [0, 0, 7]])
    cloud.log_scales[:] = 4.0
    cloud.opacity_logits.clamp_(-2, 2)
    camera = Camera("a", 3, 2, 4e3, 4e3, 1.5, 1.0, np.eye(4))
    medium = None
    if water:
        random = torch.Generator().manual_seed(1)
        background_sh = torch.randn(9, 3, generator=random, dtype=torch.float64)
        medium = Medium(background_sh[0].clone(), background_sh[1].clone(), background_sh, 3.0, water)
    target = torch.rand(2, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def loss(color):
        return (color - target).square().sum()

    logits = cloud.opacity_logits.clone().requires_grad_()
    leaf = GaussianCloud(**(cloud.parameters() | {"opacity_logits": logits}))
    color = render(leaf, camera, 1, medium).color
    rows = [torch.autograd.grad(value, logits, retain_graph=True)[0] for value in color.reshape(-1)]
    # d/d logit is o (1 - o) d/do
    jacobian = (torch.stack(rows) / (1 - cloud.opacities)).view(2, 3, 3, 4)
    along = 2 * (color.detach() - target)
    S, E = scores(cloud, [(camera, loss)], 1, medium)
    dimmed = 1.0
    if medium:
        ranges = cloud.means.norm(dim=1)
        dimmed = torch.exp(-medium.beta_D * ranges[:, None]).mean(1).clamp(0.1, 1) ** 2
    torch.testing.assert_close(S * dimmed, jacobian.square().sum((0, 1, 2)), rtol=1e-2, atol=0)
    torch.testing.assert_close(E * dimmed, (jacobian * along[..., None]).sum(2).square().sum((0, 1)), rtol=2e-2, atol=0)


def near_and_far():
    """400 small Gaussians at the range 2 or 6 each, spread over the image so that they hide nothing, and water."""
    cloud = make_cloud(400, seed=2)
    side = torch.arange(20).double() / 10 - 0.95
    grid = torch.cartesian_prod(side, side)
    ranges = torch.where(torch.arange(400) % 2 == 0, 2.0, 6.0).double()
    directions = torch.nn.functional.normalize(torch.cat([0.5 * grid, torch.ones(400, 1).double()], 1), dim=1)
    cloud.means[:] = directions * ranges[:, None]
    cloud.quats[:] = torch.tensor([1.0, 0, 0, 0])
    cloud.log_scales[:] = (0.008 * ranges).log()[:, None]
    beta = torch.tensor([0.3, 0.3, 0.3])
    medium = Medium.starting(3.0, "srgb", beta, beta, torch.tensor([0.2, 0.2, 0.2]))
    parameters = {name: t.double() for name, t in medium.parameters().items()}
    return cloud, ranges > 4, Medium(**parameters, unit_range=3.0, light="srgb")


def test_structure_that_water_dims_is_not_removed_first(monkeypatch):
    cloud, far, medium = near_and_far()
    camera = Camera("a", 200, 200, 200.0, 200.0, 100.0, 100.0, np.eye(4))
    views = [(camera, lambda color: color.square().mean())]

    def far_removed():
        S, E = scores(cloud, views, 1, medium)
        return far[torch.sort(S, stable=True).indices[:100]].double().mean().item()

    assert 0.35 < far_removed() < 0.65
    monkeypatch.setattr(importance, "visibility", lambda medium, offsets: torch.ones(len(offsets)))
    assert far_removed() > 0.85


def test_scores_through_the_network():
    cloud = make_cloud(30, dtype=torch.float32)
    camera = Camera("a", 48, 32, 40.0, 40.0, 24.0, 16.0, np.eye(4))
    S, E = scores(cloud, [(camera, lambda color: color.mean())], 1, WaterNetwork.starting(5.0, 0))
    assert S.isfinite().all() and (E > 0).any()
