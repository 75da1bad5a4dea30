"""QGIS's own library opens the maps that are written here."""

import json
import os
import shutil
import subprocess

import numpy as np
import pytest

from swag_engine.products.areas import make_areas
from swag_engine.products.change import make_change
from swag_engine.products.dem import make_dem
from swag_engine.products.ortho import make_ortho
from tests.scenes.flat_splats import sheet, write_run

PYTHON = "/usr/bin/python3"
"""The Python that the system's package python3-qgis belongs to."""
OPEN = """
import json, os, sys
from qgis.core import QgsApplication, QgsRasterLayer, QgsVectorLayer, QgsPointXY, QgsRaster
application = QgsApplication([], False)
application.initQgis()
found = {}
for path in sys.argv[1:]:
    if path.endswith("json"):
        layer = QgsVectorLayer(path, "layer", "ogr")
        found[path] = {"valid": layer.isValid(), "crs": layer.crs().authid(), "count": layer.featureCount(),
                       "fields": [field.name() for field in layer.fields()]}
        continue
    layer = QgsRasterLayer(path, "layer")
    extent, provider = layer.extent(), layer.dataProvider()
    values = provider.identify(QgsPointXY(extent.center()), QgsRaster.IdentifyFormatValue).results()
    found[path] = {
        "valid": layer.isValid(), "crs": layer.crs().authid(), "size": [layer.width(), layer.height()],
        "extent": [extent.xMinimum(), extent.yMinimum(), extent.xMaximum(), extent.yMaximum()],
        "bands": layer.bandCount(), "renderer": layer.renderer().type(), "values": values,
        "nodata": [provider.sourceNoDataValue(band + 1) for band in range(layer.bandCount())
                   if provider.sourceHasNoDataValue(band + 1)],
    }
print(json.dumps(found), flush=True)
os._exit(0)  # its own end can crash while layers live
"""


@pytest.fixture(scope="module")
def open_in_qgis(tmp_path_factory):
    """A function that opens files in QGIS and returns what it sees, by path."""
    environment = {
        "QT_QPA_PLATFORM": "offscreen",
        "HOME": str(tmp_path_factory.mktemp("home")),
        "PATH": "/usr/bin:/bin",
    }
    probe = [PYTHON, "-c", "import qgis.core"]
    if not os.path.exists(PYTHON) or subprocess.run(probe, env=environment, capture_output=True).returncode:
        # Not `missing`, which fails in CI: the package takes 219 others.
        pytest.skip("QGIS's library is not here: on Debian, apt-get install python3-qgis (103 MB to download).")

    def run(*paths):
        done = subprocess.run(
            [PYTHON, "-c", OPEN, *map(str, paths)], env=environment, capture_output=True, text=True, timeout=120
        )
        assert done.returncode == 0 and "{" in done.stdout, done.stderr
        return json.loads(done.stdout[done.stdout.index("{") :].splitlines()[0])

    return run


def test_qgis_opens_every_map_at_its_place(open_in_qgis, tmp_path):
    sand = sheet(0, 0, 4, 3, 0.04, lambda x, y: 0.05 * np.sin(5 * x) * np.cos(4 * y), label=1)
    run = write_run(tmp_path, [sand, sheet(1.5, 1, 2.5, 2, 0.03, 0.3, label=2)], ("sand", "coral"))
    box, areas, change = (0.0, 0.0, 4.0, 3.0), tmp_path / "areas", tmp_path / "change"
    make_ortho(run, tmp_path / "ortho.tif", 0.02, box)
    make_dem(run, tmp_path / "dem.tif", 0.02, box, derived=("slope",))
    make_areas(run, areas, 0.02, box)
    make_change(run, run, change, 0.02, box)
    maps = [
        tmp_path / "ortho.tif", tmp_path / "dem.tif", tmp_path / "dem_slope.tif", areas / "labels.tif",
        areas / "heights.tif", change / "change.tif", change / "changed.tif",
    ]  # fmt: skip
    shutil.copytree(areas, tmp_path / "öffentlich")
    patches = tmp_path / "öffentlich" / "patches.geojson"
    found = open_in_qgis(*maps, patches)
    for path in maps:
        layer = found[str(path)]
        assert layer["valid"] and layer["crs"] == "EPSG:32633" and layer["size"] == [200, 150], path
        assert layer["extent"] == pytest.approx([500_000, 4_000_000, 500_004, 4_000_003])
    assert found[str(maps[0])]["bands"] == 4 and found[str(maps[0])]["renderer"] == "multibandcolor"
    assert found[str(maps[1])]["values"]["1"] == pytest.approx(-11.7, abs=0.02)
    assert found[str(maps[1])]["nodata"] == [-9999, -9999]
    labels = found[str(maps[3])]
    assert labels["renderer"] == "paletted" and labels["values"]["1"] == 2 and labels["nodata"] == [255]
    vectors = found[str(patches)]
    assert vectors["valid"] and vectors["crs"] in ("EPSG:4326", "OGC:CRS84") and vectors["count"] == 2
    assert {"label", "name", "planar_area"} <= set(vectors["fields"])
