"""The folder of a scene that is being made: it appears when all is done, or not at all."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..base.errors import InputError
from ..base.files import locked_folder, refuse_link


@contextmanager
def new_scene(out: Path) -> Iterator[tuple[Path, Path]]:
    """Yield a folder for the scene and one for temporary files; rename the first when all is done.

    Both are in a hidden folder beside the scene; what a killed process left there is removed.

    Args:
        out: Folder of the scene, absolute; it must not exist or be empty.

    Raises:
        InputError: When it is not empty, cannot be written to, or another process works on it.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} exists and is not an empty folder: choose another folder for the scene.")
    work = out.with_name(f".{out.name}.swag-part")
    refuse_link(work)
    scene, scratch = work / "scene", work / "scratch"
    with locked_folder(work):
        try:
            _remove(scene, scratch)
            scratch.mkdir()
            (scene / "images").mkdir(parents=True)
            yield scene, scratch
            if out.exists():
                out.rmdir()
            os.replace(scene, out)
        except OSError as error:
            raise InputError(f"Cannot write {error.filename or out}: {error.strerror or error}.") from error
        finally:
            _remove(scene, scratch)


def _remove(*folders: Path) -> None:
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
