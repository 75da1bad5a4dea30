"""A device of the backend wgpu for tests: a driver that runs its kernels on the processor."""

import pytest

from swag_engine.kernels import webgpu_device
from swag_engine.kernels.webgpu_device import ALLOW_SOFTWARE, DEFAULT_LIMITS, WebGpu


class Adapter:
    """An adapter as the package wgpu has it, whose device is its name."""

    features: set[str] = set()
    limits = {"max-storage-buffer-binding-size": 2**27, "max-buffer-size": 2**28} | DEFAULT_LIMITS

    def __init__(self, name, kind, driver="driver 1", api="Vulkan"):
        self.info = {"device": name, "adapter_type": kind, "backend_type": api, "description": driver}
        self.info |= {"vendor_id": 1, "device_id": 2}

    def request_device_sync(self, **_):
        return self.info["device"]


def adapters_are(monkeypatch, *found):
    """Let the machine have these adapters only."""
    monkeypatch.setattr(webgpu_device, "_adapters", lambda: list(found))


def software_device(missing, float_atomics: bool = True) -> WebGpu:
    """Return a device with WebGPU's default limits; `missing` is the fixture, called where there is no driver."""
    if not webgpu_device._adapters():
        missing("A Vulkan driver is missing: apt-get install mesa-vulkan-drivers.")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(ALLOW_SOFTWARE, "1")
        return webgpu_device.request(float_atomics=float_atomics, default_limits=True)
