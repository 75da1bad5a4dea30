"""The step on a GPU does what the CPU's step does; on a driver that runs its kernels on the processor."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from benchmarks import gpu_check
from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.evaluation.metrics import render_color
from swag_engine.gaussians.densify import PER_GAUSSIAN
from swag_engine.kernels.backends import CPU, KERNELS
from swag_engine.kernels.hardware import hardware_for
from swag_engine.kernels.webgpu import WebGpuKernels
from swag_engine.kernels.webgpu_device import WebGpuFailure
from swag_engine.kernels.webgpu_training import ResidentGaussians
from swag_engine.scene.colmap import load_scene
from swag_engine.settings.settings import TrainSettings
from swag_engine.training import native_step
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.guard import Guard
from swag_engine.training.native_step import NativeStep
from swag_engine.training.optimizer import EPS
from swag_engine.training.pacing import speed
from swag_engine.training.resident import RESIDENT
from swag_engine.training.step import AutogradStep
from swag_engine.training.trainer import train
from swag_engine.training.webgpu_step import WebGpuStep
from tests.engine.step_scenes import (
    ALL,
    NO_BACKSCATTER,
    WATER,
    Refusing,
    exact_gradients,
    inputs_of_step,
    trainers,
)
from tests.engine.webgpu_devices import software_device
from tests.scenes.runs import train_with


@pytest.fixture(scope="module", params=["atomic floats", "compare and swap"])
def gpu(request, missing):
    return software_device(missing, request.param == "atomic floats")


@pytest.fixture
def kernels(gpu, monkeypatch):
    """The backend, registered as such."""
    monkeypatch.setitem(KERNELS, "wgpu", WebGpuKernels(CPU, lambda: gpu))
    return KERNELS["wgpu"]


@pytest.fixture(scope="module")
def make(tiny_scene, tmp_path_factory):
    return trainers(tiny_scene, tmp_path_factory)


one_gpu = pytest.mark.parametrize("gpu", ["atomic floats"], indirect=True)


def steps_of(trainer, kernels):
    """Return the step on the GPU and that on the CPU, which fail where they are left to others."""
    refusing = Refusing(trainer.inputs, trainer.selection, None)
    on_gpu = WebGpuStep(trainer.inputs, trainer.selection, refusing, kernels)
    return on_gpu, NativeStep(trainer.inputs, trainer.selection, refusing)


def outcomes_of(state):
    """Return a list that gets the loss of each step of a state when the guard records it."""
    found: list[float] = []
    state.guarded.record_step = lambda loss, problem, image, phase: found.append(loss)
    return found


def relative(got, expected):
    return float((got - expected).detach().norm() / expected.detach().norm().clamp(min=1e-12))


CASES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "3dgs": ("3dgs", "", {}),
    "water": ("swag", WATER, {}),
    "water on display values": ("swag", WATER, {}),
    "before the water": ("swag", WATER, {"with_water": False}),
    "all effects": ("swag", ALL, {}),
    "no backscatter": ("swag", NO_BACKSCATTER, {}),
    "stage two": ("swag", ALL, {"stage_two": True, "fraction": 0.95}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_step_is_that_of_the_cpu(make, kernels, case):
    recipe, effects, changes = CASES[case]
    trainer = make(recipe, effects)
    if case == "water on display values":
        trainer.state.effects.medium.light = "srgb"
    states = trainer.state, trainer._copied(trainer.state)
    target, config = inputs_of_step(trainer, **changes)
    on_gpu, on_cpu = steps_of(trainer, kernels)
    got, expected = on_gpu(states[0], target, config), on_cpu(states[1], target, config)
    states[1].statistics.add(expected.means2d_gradient, expected.radii, target.camera.width)
    states[0].synchronize()
    assert got.loss == pytest.approx(expected.loss, rel=1e-5)
    moments = states[0].optimizer.moments, states[1].optimizer.moments
    for name, (mean, square) in moments[1].items():  # after one step, the gradient and its square
        assert relative(moments[0][name][0], mean) < 2e-4, name
        assert relative(moments[0][name][1], square) < 4e-4, name
    assert relative(states[0].statistics.gradient, states[1].statistics.gradient) < 1e-4
    assert torch.equal(states[0].statistics.views, states[1].statistics.views)


@one_gpu
def test_the_speed_of_a_card_is_that_of_its_own_steps(tiny_scene, kernels, gpu, monkeypatch):
    monkeypatch.setattr(speed, "TIMED_GAUSSIANS", 500)
    monkeypatch.setattr(speed, "TIMED_WIDTH", 64)
    scene, settings, before = load_scene(tiny_scene), TrainSettings(backend="wgpu"), replace(gpu.counters)
    measured = speed.measure_speed(scene, settings)
    assert measured.milliseconds(500, 64 * 48) > 0
    assert gpu.counters.waits - before.waits == 3 * speed.TIMINGS  # by operations, each step waits several times
    monkeypatch.setattr(ResidentGaussians, "step", lambda *_: (_ for _ in ()).throw(WebGpuFailure("The card is lost.")))
    speed.measure_speed(scene, settings)
    assert hardware_for("wgpu").backend == "cpu" and "The card is lost." in kernels.failure


@pytest.mark.parametrize("case", ["3dgs", "water on display values", "all effects", "no backscatter"])
def test_gradients_are_those_of_the_float64_reference(make, kernels, monkeypatch, case):
    recipe, effects, _ = CASES[case]
    trainer = make(recipe, effects)
    if case == "water on display values":
        trainer.state.effects.medium.light = "srgb"
    state = trainer._copied(trainer.state)
    target, config = inputs_of_step(trainer)
    step = steps_of(trainer, kernels)[0]
    loss = step(state, target, config).loss
    state.synchronize()
    result, expected = exact_gradients(trainer, monkeypatch, target, config)
    assert loss == pytest.approx(result.loss, rel=1e-5)
    compared = [name for name in state.optimizer.moments if name in expected]
    assert len(compared) >= {"3dgs": 7, "all effects": 12}.get(case, 8), compared
    for name in compared:
        assert relative(10 * state.optimizer.moments[name][0], expected[name]) < 5e-4, name


@one_gpu
def test_100_steps_follow_those_of_the_cpu(make, kernels):
    """Some seconds on a driver that runs on the processor, so that differences have time to grow."""
    trainer = make()
    states = trainer.state, trainer._copied(trainer.state)
    # Undamped: here differences grow faster with damping, to .022 in 100 steps. The next test has damped steps.
    config, targets = replace(inputs_of_step(trainer)[1], epsilon=EPS), trainer.targets.at(trainer.state, 0.2)
    outcomes = [outcomes_of(state) for state in states]
    for step, state in zip(steps_of(trainer, kernels), states, strict=True):
        for i in range(100):
            step(state, targets[i % len(targets)], config)
        state.synchronize()
    got, expected = (torch.tensor(losses) for losses in outcomes)
    assert expected[-8:].mean() < 0.5 * expected[:8].mean()
    assert (got - expected).abs().max() < 1e-3  # measured: 2e-4
    for name, value in states[1].optimizer.parameters().items():
        if value.numel():  # measured: .0025 at most
            assert relative(states[0].optimizer.parameters()[name], value) < 0.02, name


def test_steps_that_are_damped_follow_those_of_the_cpu(make, kernels):
    trainer = make()
    states = trainer.state, trainer._copied(trainer.state)
    config, targets = inputs_of_step(trainer)[1], trainer.targets.at(trainer.state, 0.2)
    assert config.epsilon > EPS
    for step, state in zip(steps_of(trainer, kernels), states, strict=True):
        for i in range(5):
            step(state, targets[i % len(targets)], config)
        state.synchronize()
    for name, value in states[1].optimizer.parameters().items():
        if value.numel():  # measured: 1e-6 at most
            assert relative(states[0].optimizer.parameters()[name], value) < 1e-5, name


@pytest.mark.parametrize("name", ["opacity_logits", "exposure.raw", "sh0"])
def test_a_step_that_is_not_finite_changes_nothing(make, kernels, name):
    trainer = make()
    state, (target, config) = trainer.state, inputs_of_step(trainer)
    with torch.no_grad():
        state.optimizer.parameters()[name][0] = torch.nan
    before = {name: p.detach().clone() for name, p in state.optimizer.parameters().items()}
    step = steps_of(trainer, kernels)[0]
    step(state, target, config)
    state.synchronize()
    record = state.guarded.record
    assert record.skipped == 1 and "is not finite at the image" in record.finding
    assert name != "opacity_logits" or name in record.finding
    for name, parameter in state.optimizer.parameters().items():
        assert parameter.grad is None and torch.equal(parameter.nan_to_num(9), before[name].nan_to_num(9)), name
    assert all(not moment.any() for pair in state.optimizer.moments.values() for moment in pair)
    assert not state.statistics.views.any() and state.optimizer.steps == 0


@one_gpu
def test_dropped_gaussians_have_no_gradient_and_others_are_as_visible_on_average(make, kernels, monkeypatch):
    trainer = make()
    trainer.state.dropout = 0.3
    states = trainer.state, trainer._copied(trainer.state)
    target, config = inputs_of_step(trainer)
    on_gpu, on_cpu = steps_of(trainer, kernels)
    on_gpu(states[0], target, config)
    used = on_gpu._resident.fetch("opacities", (len(states[0].cloud),))
    dropped = (used == 0).float().mean()
    assert 0.2 < dropped < 0.4
    factors = (used > 0).float() / 0.7
    monkeypatch.setattr(native_step, "opacity_factors", lambda *_: factors)
    on_cpu(states[1], target, config)
    states[0].synchronize()
    for name, (mean, _) in states[1].optimizer.moments.items():
        assert relative(states[0].optimizer.moments[name][0], mean) < 2e-4, name
    state = trainer._copied(states[1])
    state.iteration = 1
    on_gpu(state, target, config)
    assert not torch.equal(on_gpu._resident.fetch("opacities", used.shape) == 0, used == 0)  # others in each iteration


@one_gpu
def test_what_the_cpu_changes_between_steps_counts(make, kernels):
    trainer = make()
    states = trainer.state, trainer._copied(trainer.state)
    target, config = inputs_of_step(trainer)
    outcomes = [outcomes_of(state) for state in states]
    for step, state in zip(steps_of(trainer, kernels), states, strict=True):
        step(state, target, config)
        state.synchronize()
        with torch.no_grad():
            state.cloud.log_scales[::2] += 0.5  # in place
        step(state, target, config)
        state.synchronize()
        state.replace_free(
            state.cloud.__class__(
                **{name: getattr(state.cloud, name).detach()[::2] for name in PER_GAUSSIAN},
                background=state.cloud.background,
            ),
            torch.arange(0, len(state.cloud), 2),
        )
        step(state, target, config)
        state.synchronize()
    (*_, got), (*_, expected) = outcomes
    assert len(outcomes[0]) == 3 and got == pytest.approx(expected, rel=1e-4)


def check_step(trainer, kernels, target, config, prepare=lambda step: None):
    """Make a step on the GPU after `prepare` and one on the CPU, and compare; return the one on the GPU."""
    states = trainer.state, trainer._copied(trainer.state)
    on_gpu, on_cpu = steps_of(trainer, kernels)
    prepare(on_gpu)
    got, expected = on_gpu(states[0], target, config), on_cpu(states[1], target, config)
    states[0].synchronize()
    assert got.loss == pytest.approx(expected.loss, rel=1e-5)
    for name, (mean, _) in states[1].optimizer.moments.items():
        assert relative(states[0].optimizer.moments[name][0], mean) < 2e-4, name
    return on_gpu


@one_gpu
def test_arrays_are_in_parts_where_bindings_are_small(make, kernels, gpu, monkeypatch):
    trainer = make()
    config = inputs_of_step(trainer)[1]
    whole = trainer.targets.at(trainer.state, 0.6)[0]
    height, width = whole.valid.shape[0] // 2, whole.valid.shape[1] // 2
    camera = whole.camera.resized(width)
    reduced = {name: getattr(whole, name)[::2, ::2] for name in ("pixels", "valid", "surface")}
    target = replace(whole, camera=camera, **reduced)
    monkeypatch.setattr(gpu, "largest_binding", 4 * 9 * height * width)  # what SSIM needs
    step = check_step(trainer, kernels, target, config)
    assert len(step._resident.chunks) > 2 and step._resident.chunks[0].count * 180 <= gpu.largest_binding
    monkeypatch.setattr(gpu, "largest_binding", 4 * 10 * len(trainer.state.cloud) - 4)
    with pytest.raises(MemoryError, match="reads at once"):
        steps_of(trainer, kernels)[0](trainer.state, target, config)


@one_gpu
def test_pairs_are_in_several_lists_where_one_would_be_too_long(make, kernels):
    trainer = make()
    target, config = inputs_of_step(trainer)

    def shorten(step):
        state = trainer._copied(trainer.state)
        step(state, target, config)
        resident = step._resident
        pairs = int(kernels.gpu.read(resident._shared("found"), (1, 2), torch.int32)[0, 0])
        resident.longest_list, resident._room = pairs // 2 - 1, 10

    assert check_step(trainer, kernels, target, config, shorten)._resident._lists > 2


@one_gpu
def test_what_gpu_check_times_runs(kernels, monkeypatch):
    monkeypatch.setattr(gpu_check, "DEVICE", torch.device("cpu"))
    monkeypatch.setattr(gpu_check, "SIZE", (64, 48))
    monkeypatch.setattr(gpu_check, "ROUNDS", 8)
    found = gpu_check.wgpu_timings(kernels, 300)
    # Water, lamp, gains 1, forward 5, sort by depth 8 x 4, list 1 + 2 + 1 + 1 x 4 + 1, blend 2, compare 4, backward 5,
    # outcome 1, views and Adam 7. What comes out is the outcome; calls are all that goes in.
    dispatches = 1 + 5 + 32 + 9 + 2 + 4 + 5 + 1 + 7
    assert found["dispatches a step"] == dispatches and found["called a step"] == 256 * dispatches
    assert found["uploaded a step"] == 0 and found["downloaded a step"] == 4 * 8 and found["waits a step"] == 1 / 8


@one_gpu
def test_outcomes_are_read_together_while_later_steps_run(make, kernels, gpu):
    trainer = make()
    state, config = trainer.state, inputs_of_step(trainer)[1]
    target = trainer.targets.at(state, 0.0)[0]
    step, outcomes = steps_of(trainer, kernels)[0], outcomes_of(trainer.state)
    step(state, target, config)  # is waited for, to be compared with the CPU's
    step._resident._room *= 4
    before, known = replace(gpu.counters), []
    for _ in range(16):
        step(state, target, config)
        known.append(len(outcomes) - 1)
    assert known == 15 * [0] + [8]
    assert gpu.counters.waits - before.waits == 1 and gpu.counters.uploaded == before.uploaded
    assert gpu.counters.downloaded - before.downloaded == 16 * 32
    state.synchronize(())
    assert len(outcomes) == 17 == state.optimizer.steps
    # Beside the outcomes: 54 numbers of water, lamp, camera and background and one of each image, with two moments.
    numbers = 54 + len(state.effects.models["exposure"].raw)
    assert gpu.counters.downloaded - before.downloaded == 16 * 32 + 3 * 4 * numbers


@one_gpu
def test_steps_after_one_whose_lists_are_too_short_are_made_again_in_order(make, kernels):
    trainer = make()
    states, config = (trainer.state, trainer._copied(trainer.state)), inputs_of_step(trainer)[1]
    config = replace(config, learning_rates={name: 0.1 * rate for name, rate in config.learning_rates.items()})
    targets = trainer.targets.at(trainer.state, 0.2)
    outcomes = [outcomes_of(state) for state in states]
    steps = steps_of(trainer, kernels)
    pairs: list[int] = []
    for i in range(8):
        if i == 4:  # room for some of the images only
            short = steps[0]._resident._room = sorted(pairs)[2]
        for step, state in zip(steps, states, strict=True):
            step(state, targets[i % 4], config)
        if i < 4:
            found = kernels.gpu.read(steps[0]._resident._shared("found"), (1,), torch.int32)
            pairs.append(int(found))
    for state in states:
        state.synchronize()
    assert steps[0]._resident._room > short and min(pairs) < short < max(pairs)
    assert outcomes[0] == pytest.approx(outcomes[1], abs=1e-5) and states[0].optimizer.steps == 8


@one_gpu
@pytest.mark.parametrize("case", ["3dgs", "all effects", "no backscatter"])
def test_a_view_is_rendered_from_what_is_on_the_card(make, kernels, gpu, case):
    trainer = make(*CASES[case][:2])
    state, (target, config) = trainer.state, inputs_of_step(trainer)
    step = steps_of(trainer, kernels)[0]
    for _ in range(3):
        step(state, target, config)
    state.synchronize(())
    before = gpu.counters.downloaded
    got = state.on_device.render(target.camera, 3)
    assert gpu.counters.downloaded - before == target.camera.width * target.camera.height * 4 * (4 + 2) + 8
    state.synchronize()
    on_gaussians = {key: model for key, model in state.effects.models.items() if key in ("medium", "lamp")}
    expected = render_color(state.cloud, target.camera, 3, "cpu", SceneEffects(on_gaussians))
    assert (got - expected).abs().max() < 1e-4


# -- runs --------------------------------------------------------------------------------------------------------------

FEW = TrainSettings(recipe="swag", iterations=60, width=32, max_gaussians=200, backend="wgpu", effects=ALL)


@one_gpu
def test_a_run_that_was_stopped_resumes(kernels, tiny_scene, tmp_path, monkeypatch):
    """Some seconds on a driver that runs on the processor: two runs that densify."""
    with monkeypatch.context() as patch:  # all steps are on the GPU
        patch.delattr(AutogradStep, "__call__")
        patch.delattr(NativeStep, "__call__")
        whole = train(tiny_scene, tmp_path / "whole", FEW)["metrics"]
        asked = iter(range(10**9))
        stopped = train(tiny_scene, tmp_path / "parts", FEW, should_stop=lambda: next(asked) >= 33)
        assert stopped["interrupted"] and stopped["metrics"]["iteration"] == 33
        parts = train(tiny_scene, tmp_path / "parts", FEW, resume=True)["metrics"]
    on_cpu = train(tiny_scene, tmp_path / "cpu", replace(FEW, backend="cpu"))["metrics"]
    for metrics in (parts, on_cpu):
        assert metrics["gaussians"] == pytest.approx(whole["gaussians"], rel=0.02)
        assert metrics["test_psnr"] == pytest.approx(whole["test_psnr"], abs=0.1)
    tensors = [load_checkpoint(tmp_path / name)[0] for name in ("whole", "cpu")]
    assert int(tensors[0]["adam.steps"]) == int(tensors[1]["adam.steps"]) == 60


@one_gpu
def test_effects_are_tried_in_forks_of_what_is_on_the_card(kernels, tiny_scene, tmp_path):
    def try_lamp(trainer):
        trainer.selection.to_try = ["lamp"]
        trainer.selection.switch(trainer.state, {"lamp": False})

    settings = replace(FEW, effects=ALL.replace("lamp=on,", ""))
    trials = {}
    for backend in ("wgpu", "cpu"):
        run = train_with(tiny_scene, tmp_path / backend, replace(settings, backend=backend), try_lamp)
        (trials[backend],) = run["metrics"]["trials"]
    assert trials["wgpu"]["kept"] == trials["cpu"]["kept"]
    assert trials["wgpu"]["gain"] == pytest.approx(trials["cpu"]["gain"], abs=0.05)


@one_gpu
def test_a_run_with_an_effect_that_is_not_on_the_card_trains(kernels, tiny_scene, tmp_path):
    settings = replace(FEW, iterations=10, effects=ALL.replace("caustics=off", "caustics=on"))
    psnr = [
        train(tiny_scene, tmp_path / backend, replace(settings, backend=backend))["metrics"]["test_psnr"]
        for backend in ("wgpu", "cpu")
    ]
    assert psnr[0] == pytest.approx(psnr[1], abs=0.05) and not kernels.failure


@one_gpu
def test_gaussians_cross_the_bus_only_where_something_reads_them(kernels, tiny_scene, tmp_path, monkeypatch):
    fetched = []
    fetch = WebGpuStep.fetch

    def counted(self, state, names):
        fetched.append((state.iteration, names))
        fetch(self, state, names)

    monkeypatch.setattr(WebGpuStep, "fetch", counted)
    train(tiny_scene, tmp_path / "run", FEW)
    # All at a densification, at the end of stage one and at that of the run; none at the checks of every fifth
    # iteration, nor at validations, for which the effects alone are read.
    assert [iteration for iteration, names in fetched if names is None] == [50, 54, 60], fetched
    assert {names for _, names in fetched} == {None, ()} and len(fetched) <= 3 + 10


@one_gpu
def test_a_preview_reads_what_it_shows_and_a_checkpoint_all(make, kernels, gpu):
    trainer = make()
    state, (target, config) = trainer.state, inputs_of_step(trainer)
    steps_of(trainer, kernels)[0](state, target, config)
    before, written = gpu.counters.downloaded, state.cloud.sh0.detach().clone()
    trainer._write_preview()
    effects = 3 * 4 * (54 + len(state.effects.models["exposure"].raw))
    assert gpu.counters.downloaded - before == 4 * 14 * len(state.cloud) + effects and state.on_device
    assert not torch.equal(state.cloud.sh0, written)
    before = gpu.counters.downloaded
    state.synchronize()
    numbers = sum(value[0].numel() for value in (getattr(state.cloud, name) for name in RESIDENT))
    assert gpu.counters.downloaded - before == 4 * (3 * numbers + 2) * len(state.cloud) + effects


@one_gpu
def test_the_guard_rolls_back_what_is_on_the_card(make, kernels):
    trainer = make()
    state, guard = trainer.state, Guard(400)
    target, config = inputs_of_step(trainer)
    step = steps_of(trainer, kernels)[0]

    def check():
        state.guarded.record_step(step(state, target, config).loss, "", "image", "phase")
        return guard.roll_back_if_bad(state.guarded, state.optimizer, guard.interval, state.on_device)

    state.guarded.record.best, before = 1.0, state.cloud.means.detach().clone()
    assert not check() and torch.equal(state.cloud.means, before)  # nothing was fetched
    kept = step._resident.fetch("means", tuple(before.shape))
    assert not torch.equal(kept, before)
    for bad in ("means", "shN.exp_avg_sq"):
        step(state, target, config)
        values = step._resident.fetch(bad, (len(before), step._resident.sizes[bad.split(".")[0]]))
        values[7, 0] = torch.inf
        step._resident.load(bad, values)
        config = replace(config, learning_rates={})  # so that nothing else becomes infinite
        assert guard.roll_back_if_bad(state.guarded, state.optimizer, guard.interval, state.on_device)
        assert f"{bad} is not finite" in state.guarded.record.finding
        assert torch.equal(state.cloud.means, kept) and state.optimizer.steps == 0


@pytest.mark.parametrize("what", ["a call fails", "the device is lost"])
def test_when_the_card_fails_the_run_goes_on_on_the_processor(what, missing, tiny_scene, tmp_path, monkeypatch):
    import wgpu

    gpu = software_device(missing)  # no other test has it, since it is destroyed
    kernels = WebGpuKernels(CPU, lambda: gpu)
    monkeypatch.setitem(KERNELS, "wgpu", kernels)
    step = ResidentGaussians.step
    made: list[int] = []

    def fail_later(self, *arguments):
        made.append(len(made))
        if len(made) == 57:  # Gaussians have been read at the densification of iteration 50
            if what == "the device is lost":
                gpu.device.destroy()
            else:
                monkeypatch.setattr(gpu.device.queue, "submit", failing)
        return step(self, *arguments)

    def failing(commands):
        raise wgpu.GPUError("Parent device\n  is lost.")

    synchronized = []
    fail = WebGpuStep._fail

    def noted(self, state, failure):
        fail(self, state, failure)
        synchronized.append((state.optimizer.steps, state.cloud.means.detach().clone()))

    monkeypatch.setattr(ResidentGaussians, "step", fail_later)
    monkeypatch.setattr(WebGpuStep, "_fail", noted)
    fetched = fetched_parameters(monkeypatch)
    metrics = train(tiny_scene, tmp_path / "run", FEW)["metrics"]
    notes = [note for note in metrics["notes"] if "graphics card" in note]
    assert len(notes) == 1 and notes[0].endswith("Parent device is lost. Training continued on the processor.")
    assert metrics["iteration"] == 60 and metrics["test_psnr"] > 10 and len(made) == 57
    assert len(synchronized) == 1 and torch.equal(synchronized[0][1], fetched[-1])  # the last good state


def fetched_parameters(monkeypatch):
    """Return a list that gets the means each time that a step's Gaussians are read."""
    found, copy_back = [], WebGpuStep._copy_back

    def noted(self, state, names):
        copy_back(self, state, names)
        found.append(state.cloud.means.detach().clone())

    monkeypatch.setattr(WebGpuStep, "_copy_back", noted)
    return found


@one_gpu
def test_when_the_first_gradients_are_wrong_the_processor_takes_over(kernels, gpu, tiny_scene, tmp_path, monkeypatch):
    compile_text = gpu.device.create_shader_module
    right, wrong = "m[1] += v * dx;", "m[1] += 0.9 * v * dx;"
    monkeypatch.setattr(gpu.device, "create_shader_module", lambda code: compile_text(code=code.replace(right, wrong)))
    monkeypatch.setattr(gpu, "_pipelines", {})
    metrics = train(tiny_scene, tmp_path / "run", replace(FEW, iterations=5))["metrics"]
    (note,) = (note for note in metrics["notes"] if "graphics card" in note)
    assert "computes wrongly: the gradient of means differs by" in note and metrics["iteration"] == 5


@one_gpu
def test_when_a_kernel_does_not_compile_the_processor_takes_over(kernels, gpu, tiny_scene, tmp_path, monkeypatch):
    compile_text = gpu.device.create_shader_module
    monkeypatch.setattr(gpu.device, "create_shader_module", lambda code: compile_text(code=code + "fn broken("))
    monkeypatch.setattr(gpu, "_pipelines", {})
    metrics = train(tiny_scene, tmp_path / "run", replace(FEW, iterations=5))["metrics"]
    (note,) = (note for note in metrics["notes"] if "graphics card" in note)
    assert "failed: " in note and note.endswith("Training continued on the processor.") and metrics["iteration"] == 5


@one_gpu
def test_a_run_that_does_not_fit_the_card_goes_on_with_fewer_gaussians(kernels, gpu, tiny_scene, tmp_path, monkeypatch):
    import wgpu

    create, most = gpu.device.create_buffer, 180 * 160  # bytes: the higher SH of 160 Gaussians

    def limited(size, usage):
        if size >= most:
            raise wgpu.GPUOutOfMemoryError("Not enough memory left.")
        return create(size=size, usage=usage)

    def limit(trainer):
        monkeypatch.setattr(gpu.device, "create_buffer", limited)

    metrics = train_with(tiny_scene, tmp_path / "run", replace(FEW, iterations=20), limit)["metrics"]
    assert metrics["gaussians"] < 160 and any(note.startswith("Memory ran out 1 times") for note in metrics["notes"])
    assert not kernels.failure and gpu.counters.dispatches


@one_gpu
@pytest.mark.parametrize("when", ["planning", "training"])
def test_a_run_that_never_fits_the_card_goes_on_on_the_processor(kernels, gpu, tiny_scene, tmp_path, monkeypatch, when):
    import wgpu

    def refused(size, usage):
        raise wgpu.GPUOutOfMemoryError("Not enough memory left.")

    def refuse(trainer):
        monkeypatch.setattr(gpu.device, "create_buffer", refused)

    settings = replace(FEW, iterations=20)
    if when == "planning":
        refuse(None)
    metrics = train_with(tiny_scene, tmp_path / "run", settings, refuse)["metrics"]
    expected = train(tiny_scene, tmp_path / "cpu", replace(settings, backend="cpu"))["metrics"]
    name = gpu.adapter_name
    sentence = f"The graphics card {name} has too little memory for this run. Training continued on the processor."
    assert metrics["notes"] == [*expected["notes"], sentence] and metrics["iteration"] == 20
    if when == "planning":
        assert metrics["gaussians"] == expected["gaussians"] and metrics["test_psnr"] == expected["test_psnr"]
    else:  # fewer Gaussians did not help
        assert metrics["gaussians"] < 0.5 * expected["gaussians"] and metrics["test_psnr"] > 10


@one_gpu
def test_other_recipes_say_where_they_run(kernels, gpu, tiny_scene, tmp_path):
    before = gpu.counters.dispatches
    settings = TrainSettings(recipe="watersplatting", iterations=3, width=32, max_gaussians=100, backend="wgpu")
    notes = train(tiny_scene, tmp_path / "run", settings)["metrics"]["notes"]
    assert gpu.counters.dispatches == before
    assert any(note.startswith("The recipe watersplatting does not run on the backend wgpu") for note in notes)
