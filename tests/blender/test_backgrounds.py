"""What is behind the splats of a run: the same in renders of Blender, films and images of the engine."""

import sys

import cv2
import numpy as np
import pytest

from tests.blender.splat_pictures import psnr

ENGINE = {"SWAG_ENGINE_PYTHON": sys.executable}
"""Environment of Blender, whose own Python may lack the engine's packages."""
AMOUNTS = (0.0, 0.001, 0.3, 1.0)
OFF = "lamp=off,exposure=off,caustics=off,vignetting=off"
RUNS = {
    "attenuation": ("swag", f"attenuation=on,backscatter=off,{OFF}"),
    "backscatter": ("swag", f"attenuation=on,backscatter=on,{OFF}"),
    "display values": ("seasplat", "attenuation=on,backscatter=on"),
    "no water": ("swag", f"water=off,{OFF}"),
}
"""Recipe and effects of each kind of run."""


@pytest.fixture(scope="module", params=RUNS)
def run(request, tiny_scene, tmp_path_factory):
    """The folder of a short run of each kind, as in RUNS, by its name."""
    from swag_engine.settings.settings import TrainSettings
    from swag_engine.training.trainer import train

    recipe, effects = RUNS[request.param]
    folder = tmp_path_factory.mktemp("runs") / request.param
    train(
        tiny_scene,
        folder,
        TrainSettings(iterations=40, width=64, max_gaussians=60, sh_degree=1, recipe=recipe, effects=effects),
    )
    return folder


def engine_pictures(run, tiny_scene, tmp_path):
    """Images (H, W, 3) by the engine through the first camera for AMOUNTS, and alpha (H, W), of splats of x <= -1."""
    from swag_engine.experiments.film import film_model
    from swag_engine.formats.ply import read_ply, write_ply
    from swag_engine.rendering.render import render
    from swag_engine.scene.colmap import load_scene

    splats = read_ply(run / "result.ply")
    write_ply(tmp_path / "half.ply", splats.subset(splats.positions[:, 0] <= -1))
    model = film_model(tmp_path / "half.ply", run)
    camera = load_scene(tiny_scene).views[0].camera
    rendered = [
        render(model.cloud, camera, 1, model.effects.medium, amount=amount, lamp=model.effects.lamp)
        for amount in AMOUNTS
    ]
    return [picture.color.detach().numpy() for picture in rendered], rendered[0].alpha.detach().numpy()


@pytest.mark.main_version
def test_renders_have_the_background_of_the_engine(blender, run, tiny_scene, tmp_path):
    """At every amount of water, with and without development."""
    from swag_engine.splats.development import Development

    wanted, alpha = engine_pictures(run, tiny_scene, tmp_path)
    empty = alpha == 0
    assert empty.mean() > 0.01
    developments = blender.run("backgrounds.render_run", run, tiny_scene, AMOUNTS, tmp_path / "found.npz", **ENGINE)
    found = np.load(tmp_path / "found.npz")
    for amount, picture, values in zip(AMOUNTS, wanted, developments, strict=True):
        plain = found[f"none {amount}"]
        print(run.name, amount, psnr(plain, picture), picture[empty].mean(axis=0))
        assert psnr(plain, picture) > 60 and np.abs(plain - picture)[empty].max() < 1e-3, amount
        developed = Development.from_json(values).apply(picture)
        assert psnr(found[f"auto {amount}"].clip(0, 1), developed.clip(0, 1)) > 55, amount
        assert psnr(developed.clip(0, 1), picture.clip(0, 1)) < 35
    assert np.abs(found["light"] - wanted[-1])[empty].max() < 1e-3


@pytest.mark.parametrize("run", ["attenuation"], indirect=True)
@pytest.mark.main_version
def test_eevee_and_films_have_the_background_of_water_that_only_attenuates(blender, run, tiny_scene, tmp_path):
    """The film is that of splats whose run is gone: with it, a film is the engine's image of the run."""
    wanted, alpha = engine_pictures(run, tiny_scene, tmp_path)
    assert wanted[0][alpha == 0].mean() > 0.2
    blender.run("backgrounds.render_by_eevee", run, tiny_scene, AMOUNTS[1], tmp_path / "eevee.npy", **ENGINE)
    assert psnr(np.load(tmp_path / "eevee.npy"), wanted[1]) > 55
    blender.run("backgrounds.film_without_run", run, tiny_scene, AMOUNTS, tmp_path / "film", **ENGINE)
    for number, picture in enumerate(wanted, 1):
        frame = cv2.imread(str(tmp_path / "film" / f"{number:04d}.png"))[..., ::-1] / 255
        assert psnr(frame, picture.clip(0, 1)) > 45, number


def test_set_up_render_keeps_worlds_of_users(blender):
    blender.run("backgrounds.worlds_of_users")


@pytest.mark.main_version
def test_the_background_is_that_of_one_object(blender):
    blender.run("backgrounds.first_object_with_water")


def test_worlds_of_earlier_versions_are_mended(blender, tmp_path):
    found = blender.run("backgrounds.file_of_an_earlier_version", tmp_path)
    assert np.allclose(found["True"], (0.5, 0.25, 0.75), atol=1e-4)
    assert np.allclose(found["False"], (0.21404, 0.05088, 0.52252), atol=1e-4)
