"""Every hard case through the whole loop: plan, train, evaluate, export, Blender; docs/hard-cases.md says what happens.

The CPU backend runs every case. Of each property that cases vary, the torch backend runs the first case, the WebGPU
backend one in the middle and the CUDA backend the last: what a property does to a backend's own code shows in one case.
The kernels alone meet the same cases in tests/engine/test_rasterize.py, test_cuda.py and test_water.py (HARD).
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swag_engine.experiments import evaluate_run as evaluation
from swag_engine.formats.export import export_run
from swag_engine.formats.gltf import read_glb
from swag_engine.formats.ply import read_ply
from swag_engine.gaussians.init import gaussians_from_points
from swag_engine.kernels.backends import CPU, KERNELS
from swag_engine.kernels.cuda import CudaKernels
from swag_engine.kernels.webgpu import WebGpuKernels
from swag_engine.planning import plan
from swag_engine.planning.plan import plan_scene
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.trainer import InitialCloud
from tests.engine.webgpu_devices import software_device
from tests.scenes.hard import CLOUDS, SCENES, WATER, make_hard_scene
from tests.scenes.runs import train_with

SETTINGS = TrainSettings(iterations=120, width=32, max_gaussians=150, backend="cpu")
FEW = {"torch": 6, "wgpu": 6, "cuda": 3}
"""Iterations of the slow backends."""

Catalogue = dict[str, dict[str, Any]]


def chosen(catalogue: Catalogue) -> list[Any]:
    """Parameters (case, change, backend): every case on cpu, each property's first, middle and last on the others."""
    parameters = []
    for cases in catalogue.values():
        names = list(cases)
        middle = len(names) // 2
        few = {"torch": names[:1], "wgpu": names[middle : middle + 1], "cuda": names[-1:]}
        for backend, selected in ({"cpu": names} | few).items():
            parameters += [pytest.param(name, cases[name], backend, id=f"{name}-{backend}") for name in selected]
    return parameters


def settings_for(case: str, backend: str) -> TrainSettings:
    settings = replace(SETTINGS, backend=backend, iterations=FEW.get(backend, SETTINGS.iterations))
    water, metres = WATER.get(case, ("auto", 0.0))
    return replace(settings, water_type=water, metres_per_unit=metres)


Blender = Callable[[list[Path]], dict]
"""Imports paths into Blender and returns what in_blender.py reports of them."""


@pytest.fixture(scope="module")
def blender(tmp_path_factory):
    environment = os.environ | {"BLENDER_USER_RESOURCES": str(tmp_path_factory.mktemp("blender"))}
    command = [sys.executable, str(Path(__file__).with_name("in_blender.py"))]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment) as process:

        def imported(paths: list[Path]) -> dict:
            print(json.dumps(list(map(str, paths))), file=process.stdin, flush=True)
            answer = process.stdout.readline()
            assert answer, "Blender crashed"
            return json.loads(answer)

        yield imported
        process.stdin.close()


def whole_loop(
    scene: Path,
    run: Path,
    settings: TrainSettings,
    blender: Blender,
    initial_cloud: InitialCloud = gaussians_from_points,
) -> None:
    """Train a planned scene, evaluate, export and import; assert finite numbers in every file and in Blender."""
    metrics = train_with(scene, run, settings, initial_cloud=initial_cloud)["metrics"]
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


@pytest.fixture(scope="module", autouse=True)
def costs_measured_once():
    """What effects cost depends on the machine and the size of images, not on the case."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "measured_costs", cache(plan.measured_costs))
        yield


@pytest.fixture(scope="module")
def gpu(missing):
    return software_device(missing)


@pytest.fixture
def backend(request, monkeypatch):
    """cpu, torch, wgpu on a driver that runs on the processor, or cuda: its kernels on CPU fibres."""
    if request.param == "wgpu":
        device = request.getfixturevalue("gpu")
        kernels = WebGpuKernels(CPU, lambda: device)
        monkeypatch.setitem(KERNELS, "wgpu", kernels)
        monkeypatch.setattr(kernels, "fail", lambda failure: pytest.fail(str(failure)))
    if request.param == "cuda":
        if sys.platform != "linux":
            pytest.skip("the fibres are for Linux")
        from tests.engine.cuda_fibres import Fibres

        fibres = Fibres(request.config.cache.mkdir("cuda_fibres"))
        monkeypatch.setitem(KERNELS, "cuda", CudaKernels(lambda: fibres))
    return request.param


@pytest.mark.parametrize(("case", "change", "backend"), chosen(SCENES), indirect=["backend"])
def test_hard_scenes(case, change, backend, blender, tmp_path):
    scene = make_hard_scene(tmp_path / "scene", change)
    plan_scene(scene, scene)
    whole_loop(scene, tmp_path / "run", settings_for(case, backend), blender)


@pytest.fixture(scope="module")
def plain_scene(tmp_path_factory):
    scene = make_hard_scene(tmp_path_factory.mktemp("plain") / "scene")
    plan_scene(scene, scene)
    return scene


@pytest.mark.parametrize(("case", "change", "backend"), chosen(CLOUDS), indirect=["backend"])
def test_hard_initial_gaussians(case, change, backend, blender, plain_scene, tmp_path):
    def changed(*arguments):
        cloud = gaussians_from_points(*arguments)
        change(cloud)
        return cloud

    whole_loop(plain_scene, tmp_path / "run", settings_for(case, backend), blender, changed)
