"""The color chart in Blender."""

import json

import numpy as np

from swag_engine.app.protocol import ChartRequest, parse_request


def test_a_chart_is_found_and_the_panel_shows_its_colors(blender, fake_engine, tmp_path):
    run, bare = tmp_path / "run", tmp_path / "no chart"
    run.mkdir()
    bare.mkdir()
    found = blender.run("color_chart.find", run, bare, SWAG_ENGINE_PYTHON=fake_engine)
    assert "from no run" in found["no run"] and not found["shown without run"]
    assert "None of the 3 photos shows a 24-patch color chart" in found["no chart"]
    assert found["message"] == (
        "Color chart in 7 photos: delta E 16.2 as photographed, 6.5 without water, 4.8 corrected."
    )
    start = found["before"]
    assert start[:2] == ["swag.find_color_chart", "swag.mark_color_chart"] and "Delta E of the patches:" not in start
    assert found["after"] == [
        "swag.find_color_chart", "swag.mark_color_chart",
        "Delta E of the patches:", "Photos", "16.2", "Without Water", "6.5", "Corrected", "4.8",
        "Patch Left Out", "5.2",
        "Attenuation", "From Chart", "0.350 0.120 0.080", "Found in these photos:",
        "0.jpg", "1.jpg", "2.jpg", "3.jpg", "+ 3",
    ]  # fmt: skip
    # The middle of the photo, a place in it, and a direction that it does not show; the request names the photo.
    assert np.allclose(found["places"][:2], [(0.5, 0.5), (0.25, 0.25)], atol=1e-6) and found["places"][2] is None
    assert found["request"]["marked"] == "a photo.jpg:" + ",".join(["0.250000,0.500000"] * 4)
    assert isinstance(parse_request(json.dumps(found["request"])), ChartRequest)
    assert found["damaged"] == [["swag.find_color_chart", "swag.mark_color_chart"]] * 4
