"""Every hard case through the whole loop: plan, train, evaluate, export; docs/hard-cases.md says what happens in each.

The kernels alone meet the same cases in tests/engine/test_rasterize.py, test_cuda.py and test_water.py (HARD).
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hard import CLOUDS, SCENES, SIZES, WATER, make_hard_scene

from swag_engine.effects import plan
from swag_engine.evaluation import run as evaluation
from swag_engine.formats.export import export_run
from swag_engine.formats.gltf import read_glb
from swag_engine.formats.ply import read_ply
from swag_engine.rasterize import cuda
from swag_engine.training import loop
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.config import TrainSettings

SETTINGS = TrainSettings(iterations=200, width=32, max_gaussians=150, backend="cpu")
FEW = {"torch": 6, "cuda": 3}
"""Iterations of the slow backends."""

EXAMINED = ("auto", "cores", "system", "engine", "python")
"""Of the machine, for the report: nothing that matters here, and it would ask torch for its card."""


def settings_for(case: str, backend: str) -> TrainSettings:
    settings = replace(SETTINGS, backend=backend, iterations=FEW.get(backend, SETTINGS.iterations))
    water, metres = WATER.get(case, ("auto", 0.0))
    return replace(settings, water_type=water, metres_per_unit=metres)


def whole_loop(scene: Path, run: Path, settings: TrainSettings) -> None:
    """Everything that a user does; every file has finite numbers and is read back."""
    plan.plan_scene(scene, run)
    metrics = loop.train(scene, run, settings)["metrics"]
    tensors, _ = load_checkpoint(run)
    bad = [name for name, tensor in tensors.items() if not tensor.isfinite().all()]
    assert not bad, bad
    assert metrics["iteration"] == settings.iterations and metrics["gaussians"] >= 1
    evaluation.evaluate_run(run)
    for kind in ("ply", "glb"):
        export_run(run, kind, run / f"exported.{kind}")
    for splats in (read_ply(run / "exported.ply"), read_glb(run / "exported.glb")):
        arrays = [value for value in vars(splats).values() if isinstance(value, np.ndarray)]
        assert len(arrays) >= 5 and all(np.isfinite(array).all() for array in arrays)
    for path in run.glob("*.json"):
        json.loads(path.read_text(), parse_constant=pytest.fail)


@pytest.fixture
def backend(request, monkeypatch):
    """cpu, torch, or cuda: its kernels on CPU fibres."""
    if request.param == "cuda":
        if sys.platform != "linux":
            pytest.skip("the fibres are for Linux")
        from tests.engine.cuda_fibres import Fibres

        fibres = Fibres(request.config.cache.mkdir("cuda_fibres"))
        monkeypatch.setattr(cuda, "driver", lambda: fibres)
        monkeypatch.setattr(evaluation, "examine", lambda: {"packages": {}} | dict.fromkeys(EXAMINED, ""))
        for module in (loop, evaluation, plan):
            monkeypatch.setattr(module, "device_for", lambda backend: torch.device("cpu"))
    return request.param


@pytest.mark.parametrize("backend", ["cpu", "torch", "cuda"], indirect=True)
@pytest.mark.parametrize("case", [*SCENES, *SIZES, *WATER])
def test_hard_scenes(case, backend, tmp_path):
    whole_loop(make_hard_scene(case, tmp_path / "scene"), tmp_path / "run", settings_for(case, backend))


@pytest.fixture(scope="module")
def plain_scene(tmp_path_factory):
    return make_hard_scene("", tmp_path_factory.mktemp("plain") / "scene")


@pytest.mark.parametrize("backend", ["cpu", "torch", "cuda"], indirect=True)
@pytest.mark.parametrize("case", CLOUDS)
def test_hard_clouds(case, backend, plain_scene, tmp_path, monkeypatch):
    """Gaussians that a run starts from."""
    begin = loop.gaussians_from_points

    def changed(*arguments):
        cloud = begin(*arguments)
        CLOUDS[case](cloud)
        return cloud

    monkeypatch.setattr(loop, "gaussians_from_points", changed)
    whole_loop(plain_scene, tmp_path / "run", settings_for(case, backend))
