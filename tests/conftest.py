"""What every test may use."""

import os
import sys
from pathlib import Path

import pytest

import swag_engine.base.threads  # noqa: F401

sys.path.insert(0, str(Path(__file__).parent / "scenes"))


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """Undistorted photographs go to a folder of the session's own, in child processes too."""
    os.environ["SWAG_CACHE_DIR"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory):
    from tiny import make_tiny_scene

    return make_tiny_scene(tmp_path_factory.mktemp("tiny") / "wall of discs")
