"""RealityScan (RealityCapture): XMP files beside the photos, of which one stands for all in its folder and below.

Source: "RealityCapture XMP Camera Math" of RealityScan's support. `Rotation` is from the world to the camera, row by
row; `Position` is the projection centre.
"""

import xml.etree.ElementTree as ElementTree

from ..scene.lenses import Lens
from .camera_file import Calibration, CameraFile, FileCamera, pose_from_centre, reading
from .realityscan_csv import FILM_WIDTH, PROGRAM, film_calibration
from .source import Source

_XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
_POLYNOMIAL = ("brown3", "brown4", "brown3t2", "brown4t2", "k+brown3", "k+brown4", "perspective", "")


def recognise(source: Source) -> bool:
    """Return whether the file has a description by RealityScan."""
    return source.xml is not None and _description(source.xml) is not None


def read(source: Source) -> CameraFile:
    """Read all XMP files in the folder and below.

    Raises:
        ValueError: For a file that is damaged.
    """
    folder = source.path.parent
    shared: dict[tuple[object, ...], Calibration] = {}
    cameras, without_pose = [], 0
    for path in sorted(folder.rglob("*.[xX][mM][pP]")):
        root = Source(path).xml
        description = _description(root) if root is not None else None
        if description is None:
            continue
        name = path.relative_to(folder).with_suffix("").as_posix()
        with reading(path.name):
            if not _value(description, "Rotation") or not _value(description, "Position"):
                without_pose += 1
                continue
            rotation = [float(word) for word in _value(description, "Rotation").split()]
            if len(rotation) != 9:
                raise ValueError(f"Rotation has {len(rotation)} numbers instead of 9")
            centre = [float(word) for word in _value(description, "Position").split()]
            pose = pose_from_centre([rotation[:3], rotation[3:6], rotation[6:]], centre)
            key = _key(description)
            cameras.append(FileCamera(name, shared.setdefault(key, _calibration(*key)), pose))
    warnings = []
    if without_pose:
        warnings.append(f"{without_pose} XMP files in {folder} have no pose and are left out.")
    return CameraFile(PROGRAM, tuple(cameras), warnings=warnings)


def _description(root: ElementTree.Element) -> ElementTree.Element | None:
    return next((element for element in root.iter() if any(key.startswith(_XCR) for key in element.attrib)), None)


def _value(description: ElementTree.Element, name: str) -> str:
    """Return an attribute, or the text of a child; newer versions write either."""
    return (description.get(_XCR + name) or description.findtext(_XCR + name) or "").strip()


def _key(description: ElementTree.Element) -> tuple[str, tuple[float, ...], tuple[float, ...]]:
    model = _value(description, "DistortionModel").lower()
    names = ("FocalLength35mm", "PrincipalPointU", "PrincipalPointV", "AspectRatio", "Skew")
    numbers = tuple(float(_value(description, name) or (1.0 if name == "AspectRatio" else 0.0)) for name in names)
    distortion = tuple(float(word) for word in _value(description, "DistortionCoeficients").split())
    return model, numbers, (*distortion, *(0.0,) * 6)[:6]


def _calibration(model: str, numbers: tuple[float, ...], distortion: tuple[float, ...]) -> Calibration:
    focal, u, v, aspect, skew = numbers
    if not any(distortion) or model in _POLYNOMIAL:
        return film_calibration(focal, (u, v), distortion[:4], distortion[4:], aspect, skew)
    if model == "division" and not skew:

        def lens(width: int, height: int) -> Lens:
            side = max(width, height)
            fx = focal * side / FILM_WIDTH
            point = width / 2 + u * side, height / 2 + v * side
            return Lens("DIVISION", width, height, (fx, fx * aspect, *point, distortion[0]))

        return Calibration(lens)
    raise ValueError(f"the distortion model {model} cannot be used: choose Brown4 with tangential2 in RealityScan")
