"""Maps as Cloud Optimized GeoTIFF files, with their preview, and maps that are read back."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError, remedy
from ..base.files import atomic_path, unexplained
from .grid import MapGrid
from .map_frame import MapScene
from .packages import require_packages
from .tiles import Tile

BLOCK = 512
"""Edge of the blocks in a file, pixels."""
NO_HEIGHT = -9999.0
"""Value of pixels without a height."""
NO_LABEL = 255
"""Value of pixels in which nothing was seen, in a label map."""
LOCAL_METRES = 'LOCAL_CS["Local metres",UNIT["metre",1.0]]'
Color = tuple[int, int, int]


@dataclass(frozen=True)
class MapWriter:
    """Writes tiles to the file that `create_map` made."""

    dataset: Any

    def write(self, tile: Tile, values: np.ndarray) -> None:
        """Write a tile (height, width, bands)."""
        from rasterio.windows import Window

        window = Window(tile.column, tile.row, tile.width, tile.height)
        self.dataset.write(np.moveaxis(values, -1, 0).astype(self.dataset.dtypes[0]), window=window)


def map_crs(scene: MapScene) -> Any:
    """Return the coordinate reference system of a map, None for a map that is not in metres.

    Raises:
        InputError: If the system is not known to PROJ, or is in degrees.
    """
    rasterio = require_packages()
    if scene.unit != "m":
        return None
    if scene.placement is None or scene.placement.crs is None:
        return rasterio.crs.CRS.from_wkt(LOCAL_METRES)
    name = scene.placement.crs
    try:
        with rasterio.Env():  # without it GDAL writes its own line about an error, too
            crs = rasterio.crs.CRS.from_user_input(name)
    except rasterio.errors.CRSError as error:
        raise InputError(
            f"The coordinate reference system {name} is not known: "
            f"{remedy('measure the scale again with --crs EPSG:NUMBER', 'measure the scale again')}."
        ) from error
    if crs.is_geographic:
        raise InputError(
            f"The coordinate reference system {name} is in degrees, and a map needs metres: measure the scale again "
            "with reference points in a projected system, such as the UTM zone of the place."
        )
    return crs


def map_transform(scene: MapScene, grid: MapGrid) -> Any:
    """Return the affine transform from pixels to coordinates, placement included."""
    from affine import Affine

    x, y = scene.placement.offset[:2] if scene.placement else (0.0, 0.0)
    return Affine(grid.pixel, 0, grid.left + x, 0, -grid.pixel, grid.top + y)


@contextmanager
def create_map(
    path: Path,
    scene: MapScene,
    grid: MapGrid,
    bands: Sequence[str],
    dtype: str,
    nodata: float | None = None,
    palette: Mapping[int, Color] | None = None,
    tags: Mapping[str, str] | None = None,
) -> Iterator[MapWriter]:
    """Yield a writer for the tiles of a Cloud Optimized GeoTIFF; the file is whole or absent.

    Args:
        path: The file.
        scene: What the map shows.
        grid: Its pixels.
        bands: Descriptions of the bands; four colors end with alpha.
        dtype: Name of a numpy dtype.
        nodata: Value of pixels without data.
        palette: Colors of values, for one band of uint8.
        tags: Further metadata.

    Raises:
        InputError: If the name is not that of a TIFF, or the file cannot be written.
    """
    rasterio = require_packages()
    from rasterio._err import CPLE_BaseError
    from rasterio.enums import ColorInterp
    from rasterio.shutil import copy

    check_name(path)
    crs = map_crs(scene)
    with atomic_path(path) as temporary:
        work = temporary.with_name(f"work-{path.name}")
        profile = {
            "driver": "GTiff", "width": grid.width, "height": grid.height, "count": len(bands), "dtype": dtype,
            "crs": crs, "transform": map_transform(scene, grid), "nodata": nodata, "tiled": True,
            "blockxsize": BLOCK, "blockysize": BLOCK, "compress": "deflate", "bigtiff": "if_safer",
        }  # fmt: skip
        if len(bands) >= 3:
            profile["photometric"] = "rgb"
        try:
            with rasterio.open(work, "w", **profile) as dataset:
                for number, name in enumerate(bands, start=1):
                    dataset.set_band_description(number, name)
                if bands[-1] == "alpha":
                    dataset.colorinterp = (*dataset.colorinterp[:3], ColorInterp.alpha)
                if palette:
                    dataset.write_colormap(1, {value: (*color, 255) for value, color in palette.items()})
                dataset.update_tags(UNITS="metres" if scene.unit == "m" else "units of the scene", **(tags or {}))
                yield MapWriter(dataset)
            resampling = "nearest" if palette else "average"
            predictor = "NO" if palette else "YES"
            copy(
                work, temporary, driver="COG", compress="deflate", predictor=predictor, blocksize=BLOCK,
                bigtiff="if_safer", resampling=resampling, overviews="auto",
            )  # fmt: skip
        except (rasterio.errors.RasterioError, CPLE_BaseError) as error:
            raise unexplained(temporary, str(error)) from error


def check_name(path: Path) -> None:
    """Refuse names of files that do not end in .tif or .tiff.

    Raises:
        InputError: For another name.
    """
    if path.suffix.lower() not in (".tif", ".tiff"):
        raise InputError(f"{path.name} is no GeoTIFF: choose a name that ends in .tif.")


@dataclass(frozen=True, eq=False)
class MapImage:
    """A map that was read.

    Attributes:
        values: (H, W) or (H, W, C) values of the bands.
        transform: Affine transform from pixels to coordinates.
        nodata: Value of pixels without data.
        crs: Coordinate reference system.
    """

    values: np.ndarray
    transform: Any
    nodata: float | None
    crs: Any


def read_map(path: Path, tile: Tile | None = None, margin: int = 0) -> MapImage:
    """Read a map.

    Args:
        path: The file.
        tile: The part to read; all without it.
        margin: Pixels around the tile that are read, too; beyond the edges of the map they have no data.

    Raises:
        InputError: If the file is no image that GDAL reads.
    """
    from rasterio.windows import Window

    with _opened(path) as dataset:
        window = None
        if tile is not None:
            window = Window(tile.column - margin, tile.row - margin, tile.width + 2 * margin, tile.height + 2 * margin)
        values = dataset.read(window=window, boundless=margin > 0, fill_value=dataset.nodata if margin else None)
        values = np.moveaxis(values, 0, -1)
        return MapImage(
            values[..., 0] if values.shape[2] == 1 else values, dataset.transform, dataset.nodata, dataset.crs
        )


def map_size(path: Path) -> tuple[int, int]:
    """Return the number of columns and rows of a map.

    Raises:
        InputError: If the file is no image that GDAL reads.
    """
    with _opened(path) as dataset:
        return dataset.width, dataset.height


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Yield the dataset of a file. Raises InputError for one that GDAL does not read."""
    rasterio = require_packages()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)  # a PNG has no place
            dataset = rasterio.open(path)
        with dataset:
            yield dataset
    except rasterio.errors.RasterioError as error:
        raise InputError(f"{path} cannot be read: {error}.") from error
