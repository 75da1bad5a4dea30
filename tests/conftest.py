"""Fixtures of all tests, and which tests belong to which run.

`make test` runs the quick ones: the packages of the engine, and one Blender version. `make check` runs all but the wide
searches, which `make search` runs.
"""

import compileall
import os
import sys
from functools import partial
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:
    # With several workers each has one core: threads of numpy and torch would only wait for one another.
    os.environ["OMP_NUM_THREADS"] = "1"
else:
    # Hundreds of processes import these. They are compiled once, and not by a process that a test kills or lets write
    # only a few bytes, which would leave a part of a compiled module.
    for folder in ("swag_engine", "tests", "benchmarks"):
        compileall.compile_dir(Path(__file__).parents[1] / folder, quiet=1)
os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
sys.dont_write_bytecode = False  # for pytest, which compiles the tests

import pytest

import swag_engine.base.threads  # noqa: F401

ROOT = Path(__file__).resolve().parents[1]
MAIN_VERSION = "5.3" if (ROOT / ".venv" / "blender-5.3" / "python").exists() else "4.5"
"""The Blender version that the quick tests run in: the current one, which needs a Python of its own."""
QUICK_BLENDER = ("test_scene_import", "test_extension", "test_panels", "test_server", "test_export")
"""Files of tests/blender that belong to `make test`."""
NOT_QUICK = (
    "test_sanitizer", "test_command_line", "test_batch", "test_worker", "test_semantics_training", "test_demo_scene",
    "test_dropout", "test_sfm", "test_sfm_video", "test_tradeoff", "test_semantics_run", "test_forecast", "test_ablate",
    "test_semantics_real_networks", "test_training_water", "test_effects_training", "test_time_budget",
    "test_interpolation", "test_cuda", "test_webgpu_runs", "test_recipes", "test_evaluation", "test_report",
    "test_lpips_real", "test_camera_accuracy", "test_color_chart", "test_instruction_sets",
)  # fmt: skip
"""Files of tests/engine that take long or download: whole runs, processes, kernels on slow stand-ins, real weights."""
LONGEST = (
    "test_real_window", "test_worker", "test_train_operator", "test_survey_faults", "test_maps", "test_real_viewport",
    "test_labels", "test_install_engine", "test_find_cameras", "test_bad_photos", "test_surveys", "test_sanitizer",
    "test_survey_ray", "test_make_environment", "test_webgpu_step", "test_sfm", "test_crash_safety",
)  # fmt: skip
"""Files that take more than a minute, which begin first: at the end they would keep one worker and leave the others."""


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """Undistorted photographs go to a folder of the session's own, in child processes too."""
    os.environ["SWAG_CACHE_DIR"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="session")
def missing():
    """Call it with a sentence that says which tool is missing and how to install it.

    The test is skipped; where the environment variable CI is set, it fails.
    """
    return partial(pytest.fail, pytrace=False) if os.environ.get("CI") else pytest.skip


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory):
    from tests.scenes.tiny import make_tiny_scene

    return make_tiny_scene(tmp_path_factory.mktemp("tiny") / "wall of discs")


@pytest.fixture(scope="session")
def finished_run(tiny_scene, tmp_path_factory):
    """The folder of a finished run of the tiny scene, for tests that read; copy it where files are added or changed."""
    from swag_engine.settings.settings import TrainSettings
    from swag_engine.training.trainer import train

    folder = tmp_path_factory.mktemp("runs") / "a <b> & c"
    train(tiny_scene, folder, TrainSettings(iterations=40, width=64, max_gaussians=400, sh_degree=1))
    return folder


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark the tests of `make test`, and what other Blender versions only repeat; put the longest files first."""
    order = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))
    for item in items:
        version = getattr(item, "callspec", None) and item.callspec.params.get("blender")
        if version not in (None, MAIN_VERSION) and item.get_closest_marker("main_version"):
            item.add_marker(pytest.mark.search)
        folder, name = item.path.parent.name, item.path.stem
        in_blender = folder == "blender" and name in QUICK_BLENDER and version in (None, MAIN_VERSION)
        if in_blender or (folder == "engine" and name not in NOT_QUICK):
            item.add_marker(pytest.mark.quick)
