"""Development of the colors of splats in Blender; viewports are in test_real_viewport.py."""

import json

import numpy as np

from swag_engine.app.protocol import FilmRequest, RestoreRequest, parse_request
from swag_engine.formats.ply import write_ply
from swag_engine.formats.run_folder import RunFolder
from swag_engine.settings.settings import TrainSettings
from swag_engine.splats.development import ColorView, Development
from swag_engine.splats.splats import Splats
from tests.blender.splat_pictures import heap, psnr, render_by_engine


def test_sliders_and_water_give_the_development_of_a_picture(blender):
    blender.run("colors.sliders")


def test_a_developed_render_equals_the_engines_developed_image(blender, tmp_path):
    np.savez(tmp_path / "heap.npz", **heap())
    development = Development.from_json(blender.run("colors.render_developed", tmp_path))
    render = np.load(tmp_path / "render.npy")
    color, alpha = render_by_engine(heap(), 160, 100, 150.0)
    alpha = alpha[..., None]
    wanted = development.apply(color / np.maximum(alpha, 1e-6)) * alpha
    assert psnr(render[..., :3], wanted) > 50 and psnr(color, wanted) < 28


def test_renders_follow_the_sliders_and_the_animated_water(blender):
    blender.run("colors.render_follows_sliders_and_water", seconds=120)


def test_a_developed_render_needs_no_graphics_library(blender, tmp_path, monkeypatch):
    """In a process of its own that cannot load libEGL; five seconds with its start."""
    np.savez(tmp_path / "heap.npz", **heap())
    (tmp_path / "libEGL.so.1").touch()
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))
    without = blender.fresh()
    try:
        without.run("colors.render_developed", tmp_path)
    finally:
        without.quit()


def test_films_and_exported_files_are_developed(blender, tmp_path):
    sent = blender.run("colors.film_and_files", tmp_path)
    request = {"request": "film", "cameras": "a", "splats": "b", "out": "c", "colors": sent}
    parsed = parse_request(json.dumps(request))
    assert isinstance(parsed, FilmRequest) and parsed.colors == ColorView.from_json(sent)


def test_an_opened_run_has_its_development_and_damage_is_named(blender, tmp_path):
    write_ply(tmp_path / "result.ply", Splats(**heap()))
    RunFolder(tmp_path).write_config(tmp_path, TrainSettings(), [0, -1, 0])
    assert "development is damaged" in blender.run("colors.open_run_with_development", tmp_path)


def test_photos_are_restored_in_the_colors_of_the_panel(blender, fake_engine, tmp_path):
    found = blender.run("colors.restore_photos", tmp_path, SWAG_ENGINE_PYTHON=fake_engine)
    assert "from no run on this machine" in found["no run"]
    assert found["message"] == f"2 photos without water: {tmp_path / 'restored_photos'}"
    assert not found["shown"] and found["panel"][0] == "swag.restore_photos"
    assert "2 photos without water:" in found["panel"]
    request = parse_request((tmp_path / "restored_photos" / "request.json").read_text())
    assert isinstance(request, RestoreRequest) and request.run == tmp_path
    assert request.colors.restored.exposure == 0.7 and request.colors.adjusted.exposure == 1
