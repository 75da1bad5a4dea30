"""The extension as a zip: it builds, validates, installs, enables, and is removed completely."""

import zipfile

import numpy as np

from swag_engine.formats.ply import write_ply
from swag_engine.settings.settings import TrainSettings
from swag_engine.splats.splats import Splats


def test_zip_contains_what_runs_and_nothing_else(extension_zip):
    with zipfile.ZipFile(extension_zip) as archive:
        names = archive.namelist()
    for needed in ("__init__.py", "blender_manifest.toml", "LICENSE", "constraints.txt", "requirements.txt",
                   "swag_engine/app/worker.py", "swag_engine/kernels/photo.wgsl", "swag_blender/panels.py",
                   "operators/train.py"):  # fmt: skip
        assert needed in names
    assert any(name.startswith("swag_engine/kernels/lib/") for name in names)
    tops = {name.split("/")[0] for name in names}
    assert not tops & {"tests", "demo", "benchmarks", "dist", "docs", ".venv", ".git", ".ci", "Makefile"}
    assert not [name for name in names if "__pycache__" in name or "/." in name]


def test_registering_and_unregistering_twice_leaves_nothing(blender):
    blender.run("registration.register_twice")
    assert "duplicate command" not in blender.printed


def test_defaults_are_the_engines(blender):
    assert blender.run("registration.default_settings") == TrainSettings().to_json()


def test_blender_imports_no_module_that_only_the_engine_needs(blender, tmp_path):
    ones = np.ones((2, 3), np.float32)
    splats = Splats(ones, np.array([[1, 0, 0, 0]] * 2, np.float32), ones, np.ones(2, np.float32), ones[:, None])
    write_ply(tmp_path / "splats.ply", splats)
    assert blender.run("registration.heavy_modules", tmp_path) == []
