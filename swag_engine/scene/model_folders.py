"""Where COLMAP models lie in the folder of a scene. Blender imports it: no pycolmap here."""

from pathlib import Path


def folders_of_models(scene: Path) -> list[Path]:
    """List the folders of a scene that may hold a model: itself, sparse, colmap/sparse, colmap, folders in them."""
    folders = []
    for base in (scene, scene / "sparse", scene / "colmap" / "sparse", scene / "colmap"):
        if base.is_dir():
            folders += [base, *sorted(child for child in base.iterdir() if child.is_dir())]
    return list(dict.fromkeys(folders))


def model_suffix(folder: Path) -> str | None:
    """Return .bin or .txt when the folder holds a complete model, binary first as in COLMAP, else None.

    The points may be those of a PLY file instead.
    """
    for parts in (("cameras", "images", "points3D"), ("cameras", "images")):
        for suffix in (".bin", ".txt"):
            if all((folder / f"{part}{suffix}").is_file() for part in parts):
                return suffix if len(parts) == 3 or points_beside(folder) else None
    return None


def points_beside(folder: Path) -> Path | None:
    """Return the PLY file of points in the folder of a model or in its parent, as VGGT and trainers write it."""
    for parent in (folder, folder.parent):
        for name in ("points3D.ply", "sparse.ply", "points.ply"):
            if (parent / name).is_file():
                return parent / name
    return None


def scene_of(folder: Path) -> Path:
    """Return the scene's folder for a folder of COLMAP within it (sparse/0, colmap/sparse, ...), else the folder."""
    scene = folder.parent if folder.name.isdecimal() else folder
    if scene.name.lower() != "sparse":
        return folder
    return scene.parent.parent if scene.parent.name.lower() == "colmap" else scene.parent


def scene_with_model(folder: Path) -> Path | None:
    """Find the scene of a folder: a folder with a model, of COLMAP within the scene, or the scene's folder images.

    Returns:
        The folder of the scene; None where there is no complete model. An OSError of an unreadable folder is not
        caught.
    """
    scene = scene_of(folder)
    for candidate in (scene, scene.parent) if scene.name.lower() == "images" else (scene,):
        if any(model_suffix(models) for models in folders_of_models(candidate)):
            return candidate
    return None
