"""Splats that Blender 5.3 draws itself: colors, renders, and files of other versions."""

import numpy as np
import pytest

from tests.blender.conftest import packages
from tests.blender.splat_pictures import apply_water, heap, psnr, render_by_engine


@pytest.fixture
def native(blenders, missing):
    """Blender 5.3, which draws splats itself."""
    if not (packages("5.3") / "python").exists():
        missing("Blender 5.3 is not there: run `make .venv/ready`; it needs Python 3.13.")
    return blenders["5.3"]


@pytest.fixture(scope="module")
def medium():
    """Water whose background light changes with the direction."""
    import torch

    from swag_engine.water.medium import Medium

    medium = Medium.starting(
        4.0, "linear", torch.tensor([0.12, 0.08, 0.03]), torch.tensor([0.05, 0.07, 0.09]), torch.tensor([0.1, 0.3, 0.5])
    )
    medium.background_sh[1:] = torch.randn(8, 3, generator=torch.Generator().manual_seed(2)) * 0.3
    return medium


def own_colors(arrays, eye):
    """Display colors (N, 3) of splats from a place, by the engine, and their offsets from it."""
    import torch

    from swag_engine.gaussians.sh import evaluate_sh

    offsets = torch.tensor(arrays["positions"] - np.array(eye, "f4"))
    sh = torch.tensor(arrays["sh"])
    directions = torch.nn.functional.normalize(offsets, dim=1)
    return evaluate_sh(sh[:, :1], sh[:, 1:], directions, 3).numpy(), offsets.numpy()


def test_colors_are_those_of_the_engine_for_each_camera_and_frame(native, medium, tmp_path):
    arrays, amount = heap(), 0.8
    np.savez(tmp_path / "heap.npz", **arrays)
    native.run("native_splats.colored_splats", tmp_path, medium.to_json(), amount)
    found = np.load(tmp_path / "colors.npz")
    for name, eye, shown in (("first", (0, 0, 0), 0.8), ("second", (3, 1, -2), 0.8), ("animated", (0, 0, 0), 0.4)):
        colors, offsets = own_colors(arrays, eye)
        np.testing.assert_allclose(found[name], apply_water(medium, colors, offsets, shown), atol=2e-4)


def test_labels_hidden_splats_crop_density_and_degree_change_what_blender_draws(native):
    native.run("native_splats.labels_hidden_crop_and_density")


def test_colors_are_developed_once(native):
    native.run("native_splats.developed")


def test_cycles_draws_the_colors_of_copies_instances_and_linked_objects(native, medium, tmp_path):
    import torch

    from swag_engine.kernels.reference.transfer import to_light

    found = native.run("native_splats.renders", tmp_path, medium.to_json())
    found = {name: np.array(color) for name, color in found.items()}
    color = np.array([[0.8, 0.2, 0.5]])
    wet = apply_water(medium, color, np.array([[0, 0, 4]]))
    dry, wet = (to_light(torch.tensor(display)).numpy()[0] for display in (color, wet))
    np.testing.assert_allclose(found["own"][:3], dry, atol=2e-3)
    assert found["hidden"][3] == 0
    for name in set(found) - {"own", "hidden"}:
        np.testing.assert_allclose(found[name][:3], wet, atol=2e-3, err_msg=name)


@pytest.mark.parametrize("saved_in", ["4.5", "5.2"])
@pytest.mark.parametrize("exact", [False, True])
def test_files_of_earlier_versions_become_native_and_undo_takes_it_back(native, blenders, tmp_path, saved_in, exact):
    """Splats that are set up As Trained stay so."""
    blenders[saved_in].run("native_splats.save", tmp_path, saved_in, exact)
    native.run("native_splats.open_other", tmp_path / f"{saved_in}.blend", not exact)
    if not exact:
        native.run("native_splats.undo_of_the_update", tmp_path / f"{saved_in}.blend")


def test_files_of_5_3_open_in_5_2_with_own_shapes_and_4_5_says_what_it_cannot_read(native, blenders, tmp_path):
    native.run("native_splats.save", tmp_path, "5.3", False)
    blenders["5.2"].run("native_splats.open_other", tmp_path / "5.3.blend", False)
    said = blenders["4.5"].run("native_splats.open_without_colors", tmp_path / "5.3.blend")
    assert "cannot read their colors: reef. Open the file in Blender 5.2 or later" in said


def test_splats_that_blender_imported_get_the_panel(native, tmp_path):
    from swag_engine.formats.ply import write_ply
    from swag_engine.splats.splats import Splats

    arrays = heap()
    write_ply(
        tmp_path / "heap.ply", Splats(*(arrays[n] for n in ("positions", "rotations", "scales", "opacities", "sh")))
    )
    assert native.run("native_splats.imported_by_blender", tmp_path / "heap.ply") == len(arrays["positions"])


def test_viewports_draw_what_the_engine_renders(native, tmp_path):
    """The extension's own drawing, without noise and in display values, which native splats are not."""
    arrays = heap()
    np.savez(tmp_path / "heap.npz", **arrays)
    native.run("native_splats.own_drawing", tmp_path, 160, 100, 150.0)
    color = render_by_engine(arrays, 160, 100, 150.0)[0].clip(0, 1)
    drawn = np.load(tmp_path / "drawn.npy")
    print(psnr(drawn, color))
    assert psnr(drawn, color) > 42


def test_the_grid_of_the_floor_does_not_cut_through_splats_behind_it_and_a_mesh_in_the_floor_does(native, tmp_path):
    native.run("native_splats.own_drawing_behind_the_floor", tmp_path)
    found = np.load(tmp_path / "floor.npz")
    alone = {"grid": "alone", "mesh": "alone", "horizon": "horizon alone"}
    hidden = {name: (abs(found[name] - found[other]) > 0.1).any(axis=2) for name, other in alone.items()}
    print({name: mask.mean() for name, mask in hidden.items()})
    assert hidden["grid"].mean() < 0.003 and hidden["horizon"].mean() < 0.003
    # The mesh covers most of the middle, and nothing above the horizon.
    assert hidden["mesh"][60:100, 60:100].mean() > 0.9 and hidden["mesh"][:20].mean() < 0.01
