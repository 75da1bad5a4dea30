"""Every hard case through the whole loop: plan, train, evaluate, export, Blender; docs/hard-cases.md says what happens.

The kernels alone meet the same cases in tests/engine/test_rasterize.py, test_cuda.py and test_water.py (HARD).
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hard import CLOUDS, SCENES, SIZES, WATER, make_hard_scene

from swag_engine.experiments import evaluate_run as evaluation
from swag_engine.formats.export import export_run
from swag_engine.formats.gltf import read_glb
from swag_engine.formats.ply import read_ply
from swag_engine.kernels.backends import KERNELS
from swag_engine.kernels.cuda import CudaKernels
from swag_engine.planning import costs, plan
from swag_engine.settings.settings import TrainSettings
from swag_engine.training import inputs
from swag_engine.training import trainer as loop
from swag_engine.training.checkpoint import load_checkpoint

SETTINGS = TrainSettings(iterations=200, width=32, max_gaussians=150, backend="cpu")
FEW = {"torch": 6, "cuda": 3}
"""Iterations of the slow backends."""

EXAMINED = ("auto", "cores", "system", "engine", "python")
"""Of the machine, for the report: nothing that matters here, and it would ask torch for its card."""


def settings_for(case: str, backend: str) -> TrainSettings:
    settings = replace(SETTINGS, backend=backend, iterations=FEW.get(backend, SETTINGS.iterations))
    water, metres = WATER.get(case, ("auto", 0.0))
    return replace(settings, water_type=water, metres_per_unit=metres)


Blender = Callable[[list[Path]], dict]
"""What paths become in Blender, as in_blender.py says it."""


@pytest.fixture(scope="module")
def blender(tmp_path_factory):
    environment = os.environ | {"BLENDER_USER_RESOURCES": str(tmp_path_factory.mktemp("blender"))}
    command = [sys.executable, str(Path(__file__).with_name("in_blender.py"))]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, **pipes, text=True, env=environment) as process:

        def imported(paths: list[Path]) -> dict:
            print(json.dumps(list(map(str, paths))), file=process.stdin, flush=True)
            answer = process.stdout.readline()
            assert answer, "Blender crashed"
            return json.loads(answer)

        yield imported
        process.stdin.close()


def whole_loop(scene: Path, run: Path, settings: TrainSettings, blender: Blender) -> None:
    """Everything that a user does; every file has finite numbers and is read back, here and by Blender."""
    plan.plan_scene(scene, run)
    metrics = loop.train(scene, run, settings)["metrics"]
    tensors, _ = load_checkpoint(run)
    bad = [name for name, tensor in tensors.items() if not tensor.isfinite().all()]
    assert not bad, bad
    assert metrics["iteration"] == settings.iterations and metrics["gaussians"] >= 1
    evaluation.evaluate_run(run)
    exported = [run / "exported.ply", run / "exported.glb"]
    for path in exported:
        export_run(run, path.suffix[1:], path)
    for splats in (read_ply(exported[0]), read_glb(exported[1])):
        arrays = [value for value in vars(splats).values() if isinstance(value, np.ndarray)]
        assert len(arrays) >= 5 and all(np.isfinite(array).all() for array in arrays)
    for path in run.glob("*.json"):
        json.loads(path.read_text(), parse_constant=pytest.fail)
    held = blender([run, *exported])
    assert held["not finite"] == [] and held["cameras"] == len(list((scene / "images").iterdir()))
    assert [n for name, n in held["clouds"].items() if not name.endswith(" Points")] == 3 * [metrics["gaussians"]]


@pytest.fixture
def backend(request, monkeypatch):
    """cpu, torch, or cuda: its kernels on CPU fibres."""
    if request.param == "cuda":
        if sys.platform != "linux":
            pytest.skip("the fibres are for Linux")
        from tests.engine.cuda_fibres import Fibres

        fibres = Fibres(request.config.cache.mkdir("cuda_fibres"))
        monkeypatch.setitem(KERNELS, "cuda", CudaKernels(lambda: fibres))
        monkeypatch.setattr(evaluation, "examine", lambda: {"packages": {}} | dict.fromkeys(EXAMINED, ""))
        for module in (loop, inputs, evaluation, costs):
            monkeypatch.setattr(module, "device_for", lambda backend: torch.device("cpu"))
    return request.param


@pytest.mark.parametrize("backend", ["cpu", "torch", "cuda"], indirect=True)
@pytest.mark.parametrize("case", [*SCENES, *SIZES, *WATER])
def test_hard_scenes(case, backend, blender, tmp_path):
    whole_loop(make_hard_scene(case, tmp_path / "scene"), tmp_path / "run", settings_for(case, backend), blender)


@pytest.fixture(scope="module")
def plain_scene(tmp_path_factory):
    return make_hard_scene("", tmp_path_factory.mktemp("plain") / "scene")


@pytest.mark.parametrize("backend", ["cpu", "torch", "cuda"], indirect=True)
@pytest.mark.parametrize("case", CLOUDS)
def test_hard_clouds(case, backend, blender, plain_scene, tmp_path, monkeypatch):
    """Gaussians that a run starts from."""
    begin = loop.gaussians_from_points

    def changed(*arguments):
        cloud = begin(*arguments)
        CLOUDS[case](cloud)
        return cloud

    monkeypatch.setattr(loop, "gaussians_from_points", changed)
    whole_loop(plain_scene, tmp_path / "run", settings_for(case, backend), blender)
