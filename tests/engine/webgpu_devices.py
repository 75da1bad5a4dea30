"""A device of the backend wgpu for tests: a driver that runs its kernels on the processor."""

import pytest

from swag_engine.kernels import webgpu_device
from swag_engine.kernels.webgpu_device import ALLOW_SOFTWARE, WebGpu


def software_device(missing, float_atomics: bool = True) -> WebGpu:
    """Return a device with WebGPU's default limits; `missing` is the fixture, called where there is no driver."""
    if not webgpu_device._adapters():
        missing("A Vulkan driver is missing: apt-get install mesa-vulkan-drivers.")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(ALLOW_SOFTWARE, "1")
        return webgpu_device.request(float_atomics=float_atomics, default_limits=True)
