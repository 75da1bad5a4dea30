"""A GPU through WebGPU (the package `wgpu`: Vulkan, Metal and DirectX 12): buffers, kernels and their dispatches.

The kernels are the .wgsl files beside this one. A kernel's bindings and the fields of its `Call` are passed by name.
"""

import ctypes
import os
import re
import struct
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..base.computer_memory import total_memory
from ..base.errors import InputError
from .constants import wgsl

FOLDER = Path(__file__).parent
"""Folder of the sources."""
STAGES = {
    **dict.fromkeys(("activate", "activate_backward", "count_views", "find_not_finite"), "gaussians"),
    **dict.fromkeys(("set_numbers", "conclude"), "medium adam_rule effects"),
    "adam_step": "adam_rule adam",
    "blend_backward": "splat blend",
    "blend_forward": "splat blend",
    "turn_moments": "splat blend",
    "l1_ssim_backward": "ssim",
    "l1_ssim_forward": "ssim",
    "photo_backward": "basis light medium photo",
    "photo_forward": "basis light medium photo",
    "project_backward": "project",
    "project_forward": "project",
    "shade_backward": "basis light medium water",
    "shade_forward": "basis light medium water",
    "sh_backward": "basis sh",
    "sh_forward": "basis sh",
    **dict.fromkeys(("sum_blocks", "sum_totals", "count_digits", "move_by_digit"), "sort"),
    **dict.fromkeys(("pack", "count_tiles", "fill_tiles", "find_ranges"), "splat tiles"),
}
"""The files of each kernel, after common.wgsl."""
ALLOW_SOFTWARE = "SWAG_WGPU_SOFTWARE"
"""Environment variable: 1 lets a Vulkan driver that computes on the processor count as a GPU, for tests."""
FLOAT_ATOMICS = "shader-float32-atomic"
"""Feature of adapters that can add floats atomically."""
DEFAULT_LIMITS = {
    "max-storage-buffers-per-shader-stage": 8,
    "max-compute-workgroup-storage-size": 16384,
    "max-compute-invocations-per-workgroup": 256,
    "max-compute-workgroups-per-dimension": 65535,
}
"""WebGPU's default limits, which are all that the kernels need."""
KINDS = ("DiscreteGPU", "IntegratedGPU", "VirtualGPU", "Unknown", "CPU")
"""Kinds of adapters, the one that is taken first before the others."""
LAST_API = "D3D12"
"""DirectX 12: it has no atomic sums of floats, so the same card comes through Vulkan where it can."""
BAD_DRIVERS = {
    # gfx-rs/wgpu issue 7904, July 2025: sums over 64 threads come out as those of two.
    "Microsoft Basic Render Driver": "its barriers in workgroup memory do not hold",
    # gfx-rs/wgpu issue 8643, December 2025: a counter of 16 threads stays at 1. Mesa's drivers of these chips are fine.
    r"^Mali(?!.*Mesa)": "its driver adds wrongly in workgroup memory",
}
"""Adapters and drivers that are known to compute wrongly, as patterns of name and driver, and what is wrong."""
OLDEST_MESA = 22, 3
"""Oldest version of Mesa whose software driver is used: the tests ran on 22.3.6, and on none before."""
SHARED_FRACTION = 0.5
"""Fraction of the computer's memory that a graphics chip without memory of its own may take."""
DEVICE_LOCAL = 1
"""VK_MEMORY_HEAP_DEVICE_LOCAL_BIT of vulkan_core.h."""
LEAST_BUFFER = 64
"""Smallest buffer, bytes: a kernel refuses one without room for an item."""
CALL_BYTES = 256
"""Bytes from one `Call` to the next in their buffer: what every device aligns to."""
CALLS = 1024
"""Dispatches of a command buffer, at most."""
DEFAULT_BINDING = 2**27
"""Largest binding that every WebGPU device has, bytes."""


class WebGpuUnavailable(Exception):
    """No kernels can run through WebGPU here; the message says why, as a clause."""


class WebGpuFailure(InputError):
    """The device failed while it was used: it was lost, or its driver refused something.

    Attributes:
        finding: What happened, a sentence.
    """

    def __init__(self, finding: str) -> None:
        super().__init__(f"{finding} Train with the backend cpu instead.")
        self.finding = finding


@dataclass(frozen=True)
class Rows:
    """Part of a buffer, for a binding.

    Attributes:
        buffer: The buffer.
        offset: Where the part begins, bytes; a multiple of 256.
        size: Its size, bytes.
    """

    buffer: Any
    offset: int
    size: int


@dataclass
class Counters:
    """What was asked of the device since these counters were made.

    Attributes:
        dispatches: Number of dispatches.
        called: Bytes of the arguments of dispatches, `CALL_BYTES` each.
        uploaded: Bytes written to the device by the host, without those of the calls.
        downloaded: Bytes read back.
        waits: How often the host waited for the device.
    """

    dispatches: int = 0
    called: int = 0
    uploaded: int = 0
    downloaded: int = 0
    waits: int = 0


@dataclass
class WebGpu:
    """A device and what was built for it.

    Attributes:
        adapter_name: What the adapter says it is.
        software: Whether it computes on the processor.
        device: The device of the `wgpu` package.
        float_atomics: Whether kernels add floats with the adapter's own atomic operation.
        largest_binding: Largest binding of a buffer, bytes.
        memory: Memory of the adapter, bytes, None where that is not known.
        counters: What was asked of the device.
    """

    adapter_name: str
    software: bool
    device: Any
    float_atomics: bool
    largest_binding: int
    memory: int | None
    counters: Counters = field(default_factory=Counters)
    _pipelines: dict[str, Any] = field(default_factory=dict)
    _pending: list[Any] = field(default_factory=list)
    _calls: bytearray = field(default_factory=bytearray)
    _call_buffer: Any = None

    @contextmanager
    def _errors_named(self) -> Iterator[None]:
        """Turn an error of the driver, a lost device among them, into one sentence."""
        import wgpu

        try:
            yield
        except (wgpu.GPUError, RuntimeError) as error:
            self._pending.clear()
            self._calls.clear()
            if isinstance(error, wgpu.GPUOutOfMemoryError):
                raise MemoryError(f"{self.adapter_name} has too little memory.") from error
            reason = " ".join(str(error).split())
            reason = reason[:300].rstrip(".")
            raise WebGpuFailure(f"The graphics card {self.adapter_name} failed: {reason}.") from error

    def upload(self, values: Tensor) -> Any:
        """Return a buffer with the numbers of a tensor on the CPU.

        Raises:
            InputError: The driver failed; so do the other methods.
        """
        data = values.detach().contiguous().numpy()
        self.counters.uploaded += data.nbytes
        buffer = self.empty(data.size)
        if data.size:
            with self._errors_named():
                self.device.queue.write_buffer(buffer, 0, data)
        return buffer

    def empty(self, count: int) -> Any:
        """Return a buffer of `count` 32-bit numbers that are 0."""
        import wgpu

        usage = wgpu.BufferUsage.STORAGE | wgpu.BufferUsage.COPY_SRC | wgpu.BufferUsage.COPY_DST
        with self._errors_named():
            return self.device.create_buffer(size=max(LEAST_BUFFER, 4 * count), usage=usage)

    def read(self, buffer: Any, shape: tuple[int, ...], dtype: torch.dtype = torch.float32) -> Tensor:
        """Run what is pending and return the first numbers of a buffer.

        Args:
            buffer: The buffer.
            shape: Shape of the result.
            dtype: Its dtype, of 32 bits.
        """
        self.flush()
        size = 4 * int(np.prod(shape))
        if not size:
            return torch.zeros(shape, dtype=dtype)
        self.counters.downloaded += size
        self.counters.waits += 1
        with self._errors_named():
            data = bytearray(self.device.queue.read_buffer(buffer, 0, size))
        return torch.frombuffer(data, dtype=dtype).view(shape)

    def read_later(self, buffer: Any) -> Callable[[], Tensor]:
        """Run what is pending and begin to read a buffer, without waiting.

        Args:
            buffer: The buffer; what is run after this call does not change what is read.

        Returns:
            A function to be called once, which waits for its numbers where they are not there yet and returns them as
            int32.
        """
        import wgpu

        with self._errors_named():
            usage = wgpu.BufferUsage.COPY_DST | wgpu.BufferUsage.MAP_READ
            copied = self.device.create_buffer(size=buffer.size, usage=usage)
        self.copy(buffer, copied)
        self.flush()
        self.counters.downloaded += buffer.size
        with self._errors_named():
            mapped = copied.map_async(wgpu.MapMode.READ)

        def wait() -> Tensor:
            self.counters.waits += 1
            with self._errors_named():
                mapped.sync_wait()
                data = bytearray(copied.read_mapped())
                copied.destroy()
            return torch.frombuffer(data, dtype=torch.int32)

        return wait

    def write(self, buffer: Any, values: Any) -> None:
        """Overwrite the first numbers of a buffer, after what is pending.

        Args:
            buffer: The buffer.
            values: Contiguous array of numpy, of 32-bit numbers.
        """
        self.flush()
        self.counters.uploaded += values.nbytes
        if values.nbytes:
            with self._errors_named():
                self.device.queue.write_buffer(buffer, 0, values)

    def run(
        self, kernel: str, groups: int, call: Mapping[str, Any], kept: dict[Any, Any] | None = None, **buffers: Any
    ) -> None:
        """Put a dispatch behind the others; `read` runs them all.

        Args:
            kernel: Name of the kernel.
            groups: Number of groups of threads; 0 runs nothing.
            call: Values of the fields of the kernel's `Call`; those it does not need may be left out.
            kept: Where the binding of these buffers is kept for the next time.
            **buffers: The kernel's buffers, or `Rows` of them, by the names of their bindings.
        """
        if groups == 0:
            return
        if len(self._pending) >= CALLS:
            self.flush()
        with self._errors_named():
            pipeline, layout = self._pipeline(kernel, tuple(buffers))
            source = _source(STAGES[kernel], self.float_atomics)
            key = (kernel, *((b.buffer, b.offset, b.size) if isinstance(b, Rows) else b for b in buffers.values()))
            group = kept.get(key) if kept is not None else None
            if group is None:
                group = self._bound(source, layout, buffers)
                if kept is not None:
                    kept[key] = group
            columns = min(groups, DEFAULT_LIMITS["max-compute-workgroups-per-dimension"])
            self._pending.append((pipeline, group, len(self._calls), (columns, -(-groups // columns))))
            packed = source.pack(call)
            self._calls += packed + bytes(CALL_BYTES - len(packed))
            self.counters.dispatches += 1
            self.counters.called += CALL_BYTES

    def _bound(self, source: "Source", layout: Any, buffers: Mapping[str, Any]) -> Any:
        import wgpu

        if self._call_buffer is None:
            usage = wgpu.BufferUsage.UNIFORM | wgpu.BufferUsage.COPY_DST
            self._call_buffer = self.device.create_buffer(size=CALLS * CALL_BYTES, usage=usage)
        entries = [(0, Rows(self._call_buffer, 0, len(source.pack({}))))]
        for name, bound in buffers.items():
            rows = bound if isinstance(bound, Rows) else Rows(bound, 0, bound.size)
            entries.append((source.bindings[name][0], rows))
        return self.device.create_bind_group(
            layout=layout,
            entries=[
                {"binding": number, "resource": {"buffer": rows.buffer, "offset": rows.offset, "size": rows.size}}
                for number, rows in entries
            ],
        )

    def clear(self, buffer: Any, size: int | None = None) -> None:
        """Set all numbers of a buffer, or its first `size` bytes, to 0, behind what is pending."""
        self._pending.append(lambda encoder: encoder.clear_buffer(buffer, 0, size))

    def copy(self, source: Any, to: Any) -> None:
        """Copy a buffer to another one of its size, behind what is pending."""
        self._pending.append(lambda encoder: encoder.copy_buffer_to_buffer(source, 0, to, 0, source.size))

    def flush(self) -> None:
        """Submit what is pending as one command buffer."""
        if not self._pending:
            return
        pending, self._pending = self._pending, []
        calls, self._calls = self._calls, bytearray()
        with self._errors_named():
            if calls:
                self.device.queue.write_buffer(self._call_buffer, 0, calls)
            encoder = self.device.create_command_encoder()
            commands = None
            for entry in pending:
                if callable(entry):
                    if commands:
                        commands.end()
                        commands = None
                    entry(encoder)
                    continue
                pipeline, group, at, groups = entry
                commands = commands or encoder.begin_compute_pass()
                commands.set_pipeline(pipeline)
                commands.set_bind_group(0, group, [at])
                commands.dispatch_workgroups(*groups)
            if commands:
                commands.end()
            self.device.queue.submit([encoder.finish()])

    def _pipeline(self, kernel: str, names: tuple[str, ...]) -> tuple[Any, Any]:
        if kernel not in self._pipelines:
            import wgpu

            source = _source(STAGES[kernel], self.float_atomics)
            kinds = [(0, "uniform"), *(source.bindings[name] for name in names)]
            entries = [
                {
                    "binding": number,
                    "visibility": wgpu.ShaderStage.COMPUTE,
                    "buffer": {"type": kind, "has_dynamic_offset": number == 0},
                }
                for number, kind in kinds
            ]
            layout = self.device.create_bind_group_layout(entries=entries)
            key = STAGES[kernel]
            if key not in self._pipelines:
                self._pipelines[key] = self.device.create_shader_module(code=source.text)
            made = self.device.create_compute_pipeline(
                layout=self.device.create_pipeline_layout(bind_group_layouts=[layout]),
                compute={"module": self._pipelines[key], "entry_point": kernel},
            )
            self._pipelines[kernel] = made, layout
        return self._pipelines[kernel]


class Workspace:
    """Buffers by name, and what is run on them.

    Args:
        gpu: The device.
        keeps: Whether a buffer is there again, with what it held, when it is asked for by the same name. Nothing may be
            pending then that needs what it held.
    """

    def __init__(self, gpu: WebGpu, keeps: bool) -> None:
        self.gpu, self.keeps = gpu, keeps
        self._buffers: dict[str, Any] = {}
        self._bindings: dict[Any, Any] = {}

    def empty(self, name: str, count: int) -> Any:
        """Return a buffer of at least `count` 32-bit numbers; 0 where it is new.

        Raises:
            MemoryError: The device cannot read so much at once, or has too little memory.
        """
        if 4 * count > self.gpu.largest_binding:
            raise MemoryError(
                f"{4e-3 * count:.1f} kB are more than the {self.gpu.largest_binding / 1e3:.1f} kB that "
                f"{self.gpu.adapter_name} reads at once."
            )
        if not self.keeps:
            return self.gpu.empty(count)
        known = self._buffers.get(name)
        if known is None or known.size < 4 * count:
            self._bindings.clear()
            self._buffers.pop(name, None)
            known = self._buffers[name] = self.gpu.empty(count)
        return known

    def run(self, kernel: str, groups: int, call: Mapping[str, Any], **buffers: Any) -> None:
        """Put a dispatch behind the others; see `WebGpu.run`."""
        self.gpu.run(kernel, groups, call, self._bindings if self.keeps else None, **buffers)


@dataclass(frozen=True)
class Source:
    """The text of a stage, and what it says about its arguments.

    Attributes:
        text: The WGSL.
        bindings: Number and kind of each buffer by its name.
        fields: Name and type of the fields of `Call`, in their order.
    """

    text: str
    bindings: dict[str, tuple[int, str]]
    fields: tuple[tuple[str, str], ...]

    def pack(self, call: Mapping[str, Any]) -> bytes:
        """Return the bytes of `Call`."""
        unknown = call.keys() - dict(self.fields)
        if unknown:
            raise KeyError(f"Call has no field {', '.join(sorted(unknown))}")
        data = b""
        for name, kind in self.fields:
            if kind == "vec4f":
                values = [*call.get(name, ()), 0.0, 0.0, 0.0, 0.0][:4]
                data += struct.pack("<4f", *values)
            else:
                data += struct.pack("<I" if kind == "u32" else "<f", call.get(name, 0))
        return data + bytes(-len(data) % 16)


@cache
def _source(files: str, float_atomics: bool) -> Source:
    text = "".join((FOLDER / f"{name}.wgsl").read_text(encoding="utf-8") for name in ("common", *files.split()))
    text = wgsl() + re.sub(rf"(?m)^//#{'native' if float_atomics else 'swap'} ", "", text)
    found = re.findall(r"(?m)^@group\(0\) @binding\((\d+)\) var<storage, (\w+)> (\w+)", text)
    kinds = {"read": "read-only-storage", "read_write": "storage"}
    bindings = {name: (int(number), kinds[access]) for number, access, name in found}
    declared = re.search(r"struct Call \{(.*?)\}", text, re.DOTALL)
    assert declared
    lines = re.sub(r"//.*", "", declared.group(1))
    return Source(text, bindings, tuple(re.findall(r"(\w+): (\w+)", lines)))


def adapters() -> list[dict[str, Any]]:
    """List the adapters of this machine, the one that is used first.

    Returns:
        For each: `name`, `driver`, `api` ("Vulkan", "Metal", ...), `software` (whether it computes on the processor),
        `float_atomics`, `largest_binding` and `memory` (bytes) and `refused` (why it is not used, a clause; empty where
        it is). OpenGL is left out.

    Raises:
        WebGpuUnavailable: The package `wgpu` is missing or does not load.
    """
    ranked = _ranked()
    used = next((adapter.info["device"] for adapter, reason in ranked if not reason), "")
    listed: list[dict[str, Any]] = []
    for adapter, reason in ranked:
        earlier = any(not before["refused"] for before in listed)
        listed.append(_describe(adapter) | {"refused": reason or (f"{used} comes before it" if earlier else "")})
    return listed


def _adapters() -> list[Any]:
    try:
        import wgpu
    except (ImportError, OSError) as error:
        raise WebGpuUnavailable(f"the package wgpu is not installed ({error}).") from error
    if sys.platform == "linux":  # Mesa prints an error where it is not set, as on servers
        os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())
    found = wgpu.gpu.enumerate_adapters_sync()
    return [adapter for adapter in found if adapter.info["backend_type"] != "OpenGL"]


def _ranked() -> list[tuple[Any, str]]:
    """Return the adapters and why each cannot be used, empty where it can: those first, cards before graphics chips."""
    ranked = [(adapter, _refusal(adapter)) for adapter in _adapters()]

    def rank(pair: tuple[Any, str]) -> tuple[bool, int, bool]:
        info = pair[0].info
        return bool(pair[1]), KINDS.index(info["adapter_type"]), info["backend_type"] == LAST_API

    return sorted(ranked, key=rank)


def _refusal(adapter: Any) -> str:
    info = adapter.info
    for pattern, reason in BAD_DRIVERS.items():
        if re.search(pattern, f"{info['device']}, {info['description']}"):
            return reason
    if info["adapter_type"] == "CPU":
        if os.environ.get(ALLOW_SOFTWARE) != "1":
            return f"it computes on the processor; set {ALLOW_SOFTWARE}=1 to use it in tests"
        mesa = re.match(r"Mesa (\d+)\.(\d+)", info["description"])
        if mesa and tuple(map(int, mesa.groups())) < OLDEST_MESA:
            return f"{mesa[0]} is older than {OLDEST_MESA[0]}.{OLDEST_MESA[1]}, the oldest that was tested"
    for name, needed in DEFAULT_LIMITS.items():
        if adapter.limits[name] < needed:
            return f"it has {adapter.limits[name]} {name.replace('-', ' ')}, and {needed} are needed"
    return ""


def _describe(adapter: Any) -> dict[str, Any]:
    info = adapter.info
    return {
        "name": info["device"],
        "driver": info["description"],
        "api": info["backend_type"],
        "software": info["adapter_type"] == "CPU",
        "float_atomics": FLOAT_ATOMICS in adapter.features,
        "largest_binding": adapter.limits["max-storage-buffer-binding-size"],
        "memory": _memory(adapter),
    }


def _memory(adapter: Any) -> int | None:
    info, total = adapter.info, total_memory()
    if info["adapter_type"] in ("IntegratedGPU", "CPU"):
        return total and int(SHARED_FRACTION * total)
    return _vulkan_memory(info["vendor_id"], info["device_id"]) or adapter.limits["max-buffer-size"]  # a lower bound


def _vulkan_memory(vendor: int, device: int) -> int | None:
    """Ask Vulkan, since WebGPU does not tell, for the size of a card's largest own memory, bytes."""
    try:
        vulkan = ctypes.CDLL("vulkan-1.dll" if sys.platform == "win32" else "libvulkan.so.1")
    except OSError:
        return None
    instance, count = ctypes.c_void_p(), ctypes.c_uint32()
    if vulkan.vkCreateInstance((ctypes.c_uint64 * 8)(1), None, ctypes.byref(instance)):  # an empty VkInstanceCreateInfo
        return None
    sizes, found = [0], (ctypes.c_void_p * 16)()
    count.value = len(found)
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), found)
    for handle in map(ctypes.c_void_p, found[: count.value]):
        properties, memory = (ctypes.c_uint32 * 256)(), (ctypes.c_uint64 * 65)()
        vulkan.vkGetPhysicalDeviceProperties(handle, properties)
        vulkan.vkGetPhysicalDeviceMemoryProperties(handle, memory)
        if properties[2:4] == [vendor, device]:
            # Sizes and flags of 16 heaps follow 32 types of memory.
            sizes += [memory[i] for i in range(33, 65, 2) if memory[i + 1] & DEVICE_LOCAL]
    vulkan.vkDestroyInstance(instance, None)
    return max(sizes) or None


def request(float_atomics: bool = True, default_limits: bool = False) -> WebGpu:
    """Get a device: a card's before a graphics chip's; a software driver's only where `ALLOW_SOFTWARE` asks for it.

    Args:
        float_atomics: Whether to use atomic sums of floats where the adapter has them.
        default_limits: Whether to ask for WebGPU's default sizes of buffers instead of the adapter's largest.

    Returns:
        The device.

    Raises:
        WebGpuUnavailable: There is no such adapter, or it gives no device.
    """
    ranked = _ranked()
    if not ranked:
        raise WebGpuUnavailable("no graphics adapter with Vulkan, Metal or DirectX 12 was found.")
    adapter, refused = ranked[0]
    if refused:
        raise WebGpuUnavailable(f"{adapter.info['device']} is not used: {refused}.")
    features = [FLOAT_ATOMICS] if float_atomics and FLOAT_ATOMICS in adapter.features else []
    binding = DEFAULT_BINDING if default_limits else adapter.limits["max-storage-buffer-binding-size"]
    sizes = {"max-storage-buffer-binding-size": binding}
    if not default_limits:
        sizes["max-buffer-size"] = adapter.limits["max-buffer-size"]
    try:
        device = adapter.request_device_sync(required_features=features, required_limits=DEFAULT_LIMITS | sizes)
    except RuntimeError as error:
        raise WebGpuUnavailable(f"{adapter.info['device']} gave no device: {error}") from error
    found = _describe(adapter)
    return WebGpu(found["name"], found["software"], device, bool(features), binding, found["memory"])
