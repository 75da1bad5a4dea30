import numpy as np
import pycolmap

from swag_engine.sfm.model_alternatives import find_alternative
from swag_engine.sfm.plane_solutions import other_plane_solution
from tests.scenes.observed_models import floor, lawn_mower, look, make_model


def dive(count: int, step: float) -> list[np.ndarray]:
    """Poses that move straight on over a floor and look forward and down."""
    places = [np.array([3.5, step * number - 3, 2]) for number in range(count)]
    return [look(np.array([0, 1, -0.6]), np.array([0, 0, -1.0]), place) for place in places]


def bottom(relief: float) -> np.ndarray:
    """Points of a floor whose heights are multiplied by a factor."""
    return floor(6000) * [1, 1, relief]


def adjusted(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()
    return model


def test_a_short_way_over_a_flat_floor_leaves_two_solutions() -> None:
    found = find_alternative(make_model(dive(4, 0.04), bottom(0.0), noise=0.5, adjust=False))
    assert found.model is None
    assert [doubt.kind for doubt in found.doubts] == ["plane_solutions"]
    assert "focal length" in found.doubts[0].sentence


def test_a_survey_has_one_solution() -> None:
    assert other_plane_solution(make_model(lawn_mower(), bottom(0.5))) is None


def test_a_fisheye_lens_that_was_taken_for_a_perspective_one_is_found() -> None:
    focal = 420.0
    model = make_model(lawn_mower(), floor(), focal=focal, model="OPENCV_FISHEYE", adjust=False)
    camera = model.camera(1)
    perspective = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal, camera.width, camera.height)
    camera.model, camera.params = perspective.model, perspective.params.tolist()
    found = find_alternative(adjusted(model))
    assert found.model is not None and "fisheye" in found.notes[0]
    assert found.model.camera(1).model.name == "OPENCV_FISHEYE"
    assert abs(found.model.camera(1).focal_length_x / focal - 1) < 0.01


def test_a_perspective_lens_with_distortion_stays() -> None:
    model = make_model(lawn_mower(), floor(), focal=500.0, adjust=False)
    assert find_alternative(adjusted(model)).model is None
