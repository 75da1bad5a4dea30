"""Rendering of Gaussians through water as a camera sees them."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..base.camera_kind import CameraKind
from ..effects.lamp import Lamp, lit
from ..gaussians.cloud import GaussianCloud
from ..rasterize.api import Rendering, rasterize
from ..scene.cameras import Camera
from ..water.medium import MAX_DEGREE, Medium, open_water, through_water
from ..water.network import WaterNetwork

DAZZLING = 1e4
"""Largest display value that water is applied to: its power of 2.4 must not overflow."""
FARTHEST = 1e15
"""Scene units; the square of a longer range overflows."""


@dataclass
class Picture:
    """A rendered image.

    Attributes:
        color: (H, W, 3) display values.
        alpha: (H, W) in 0..1.
        range: (H, W) Euclidean distance to the camera (orthographic: depth) in scene units, alpha-weighted and
            normalised, 0 where alpha is 0; None unless asked for.
        restored: (H, W, 3) the same image without water and lamp, black where nothing is; None unless asked for.
        offsets: (N, 3) from the camera to the Gaussians (orthographic: along the optical axis only), scene units,
            without a gradient.
        rendering: What the rasteriser returned.
        behind: (H, W, 3) display color of open water in each pixel's direction; None where it is not rendered.
    """

    color: Tensor
    alpha: Tensor
    range: Tensor | None
    restored: Tensor | None
    offsets: Tensor
    rendering: Rendering
    behind: Tensor | None = None


def render(
    cloud: GaussianCloud,
    camera: Camera,
    sh_degree: int = 3,
    medium: Medium | WaterNetwork | None = None,
    water_degree: int = MAX_DEGREE,
    amount: float = 1.0,
    with_range: bool = False,
    with_restored: bool = False,
    backend: str = "auto",
    lamp: Lamp | None = None,
    kept: Tensor | None = None,
    with_background: bool = True,
) -> Picture:
    """Render a cloud as a camera sees it, in the cloud's dtype; differentiable.

    No gradient flows from color to position through the range: it would push Gaussians along rays to correct their
    colors. All of an orthographic camera's rays have the direction of its optical axis; range and water then count from
    the plane of its centre.

    Args:
        cloud: The Gaussians, without water.
        camera: The camera.
        sh_degree: Degree of the Gaussians' colors, 0..3.
        medium: Water in front of the cloud, and behind it in place of the cloud's background (a network has no
            background of its own); None without water.
        water_degree: Degree of the background light, 0..2.
        amount: Amount of water and lamp, 0 (none) to 1.
        with_range: Whether to render range.
        with_restored: Whether to render the image without water too.
        backend: What renders.
        lamp: A lamp at the camera.
        kept: (N,) factors of the opacities, which stay at most 1.
        with_background: Whether background color and background light are behind the Gaussians; without them `color`
            is premultiplied by alpha.

    Returns:
        The image.
    """
    centre, viewmat, intrinsics = (
        torch.from_numpy(array).to(cloud.means) for array in (camera.centre, camera.world_to_camera, camera.K)
    )
    offsets = _offsets(cloud.means, centre, viewmat, camera.kind)
    ranges = offsets.norm(dim=-1, keepdim=True) if with_range else None
    offsets = offsets.detach().clamp(-FARTHEST, FARTHEST)
    if camera.kind == "orthographic":
        colors = channels = cloud.colors_along(viewmat[2, :3].expand_as(cloud.means), sh_degree, backend)
    else:
        colors = channels = cloud.colors(centre, sh_degree, backend)
    background = cloud.background.sigmoid() if with_background else torch.zeros_like(cloud.background)
    has_background_light = isinstance(medium, Medium) and medium.background_sh is not None
    if lamp is not None:
        channels = lit(channels, offsets.norm(dim=1), lamp, amount)
    if medium is not None:
        if isinstance(medium, Medium):
            # Light is the power of 2.4 of a display value: without a limit an unseen Gaussian makes it overflow.
            channels = through_water(channels.clamp(max=DAZZLING), offsets, medium, water_degree, amount, backend)
            background = torch.zeros_like(background) if has_background_light else background
        else:
            channels = medium.through(channels, offsets, amount)
            background = amount * background
    if with_restored:
        channels = torch.cat([channels, colors], dim=-1)
        background = torch.cat([background, background.new_zeros(3)])
    if ranges is not None:
        channels = torch.cat([channels, ranges], dim=-1)
        background = torch.cat([background, background.new_zeros(1)])
    opacities = cloud.opacities if kept is None else (cloud.opacities * kept).clamp(max=1.0)
    rendering = rasterize(
        cloud.means,
        cloud.quats,
        cloud.scales,
        opacities,
        channels,
        viewmat,
        intrinsics,
        camera.width,
        camera.height,
        background,
        backend,
        camera.kind,
    )
    color, seen = rendering.channels[..., :3], None
    restored = rendering.channels[..., 3:6] if with_restored else None
    behind = None
    if with_background and isinstance(medium, Medium) and has_background_light and amount > 0:
        behind = open_water(
            medium, viewmat, _K_of_rays(intrinsics, camera), camera.width, camera.height, water_degree, amount, backend
        )
        color = color + (1 - rendering.alpha[..., None]) * behind
    if with_range:
        # The denominator is chosen before dividing: 0/0 behind a mask is NaN in the backward pass.
        covered = torch.where(rendering.alpha > 0, rendering.alpha, torch.ones_like(rendering.alpha))
        seen = rendering.channels[..., -1] / covered
    return Picture(color, rendering.alpha, seen, restored, offsets, rendering, behind)


def background_color(
    cloud: GaussianCloud,
    camera: Camera,
    medium: Medium | WaterNetwork | None,
    water_degree: int = MAX_DEGREE,
    backend: str = "auto",
) -> Tensor:
    """Return the display color behind all Gaussians as `render` shows it.

    Args:
        cloud: The Gaussians, whose background color counts where there is no water.
        camera: The camera.
        medium: The water, None without.
        water_degree: Degree of the background light, 0..2.
        backend: What renders.

    Returns:
        (H, W, 3), or (3,) where it is constant; differentiable.
    """
    if not isinstance(medium, Medium) or medium.background_sh is None:
        return cloud.background.sigmoid()
    viewmat, K = (torch.from_numpy(array).to(cloud.means) for array in (camera.world_to_camera, camera.K))
    return open_water(
        medium, viewmat, _K_of_rays(K, camera), camera.width, camera.height, water_degree, backend=backend
    )


def _offsets(means: Tensor, centre: Tensor, viewmat: Tensor, kind: CameraKind) -> Tensor:
    """Vectors from the camera (orthographic: from the plane of its centre) to the Gaussians, (N, 3)."""
    offsets = means - centre
    if kind == "orthographic":
        axis = viewmat[2, :3]
        offsets = (offsets @ axis)[:, None] * axis
    return offsets


def _K_of_rays(K: Tensor, camera: Camera) -> Tensor:  # noqa: N802
    """Intrinsics of a pinhole camera with the same ray directions; parallel rays are those of a very narrow view."""
    if camera.kind == "perspective":
        return K
    focal = 1e6 * max(camera.width, camera.height)
    return K.new_tensor([[focal, 0, camera.width / 2], [0, focal, camera.height / 2], [0, 0, 1]])
