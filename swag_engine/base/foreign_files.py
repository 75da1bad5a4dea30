"""Files of other programs that must be converted before they can be read."""

from pathlib import Path

from .errors import InputError, remedy

SPLAT_FILES = (".splat", ".ksplat", ".sog")
METASHAPE_PROJECTS = (".psx", ".psz")
FOREIGN_FILES = (*SPLAT_FILES, *METASHAPE_PROJECTS)
"""Endings of names, lower case."""


def refuse_foreign(path: Path) -> None:
    """Refuse a file with one of the endings FOREIGN_FILES, or a folder with a project of Metashape in it.

    Raises:
        InputError: With how to convert it.
    """
    if path.is_dir():
        path = next((file for file in sorted(path.iterdir()) if file.suffix.lower() in METASHAPE_PROJECTS), path)
    if path.suffix.lower() in SPLAT_FILES:
        converter = remedy(f"run `splat-transform {path.name} {path.stem}.ply`", "convert it with splat-transform")
        raise InputError(
            f"{path} is a {path.suffix.lower()} file, which must be a PLY: open it in the editor of SuperSplat "
            f"(superspl.at/editor) and export a PLY, or {converter}."
        )
    if path.suffix.lower() in METASHAPE_PROJECTS:
        raise InputError(
            f"{path} is a project of Metashape: choose File > Export > Export Cameras there, as Agisoft XML "
            f"({remedy('then `import-cameras`', 'then Import Cameras')}) or as COLMAP (a scene)."
        )
