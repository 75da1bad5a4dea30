"""Describe this machine: system, packages, and which backends can run."""

import os
import platform
import tomllib
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGES = (
    "torch", "numpy", "scipy", "pycolmap", "opencv-contrib-python-headless", "onnxruntime", "safetensors", "tyro",
    "rich", "platformdirs", "matplotlib", "zstandard", "pillow",
)  # fmt: skip
"""Packages that the engine needs; those of requirements.txt."""


def describe_machine() -> dict[str, Any]:
    """Describe this machine, but for its backends.

    Returns:
        `system`, `engine` (its version), `python`, `cores` and `packages` (version by name, None for one that is
        missing).
    """
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "engine": engine_version(),
        "python": platform.python_version(),
        "cores": os.cpu_count(),
        "packages": {name: _version(name) for name in PACKAGES},
    }


def examine() -> dict[str, Any]:
    """Describe this machine and its backends.

    Returns:
        As `describe_machine`; where torch is installed also `backends` (by name: whether it `runs`, the `reason` why
        not, what it runs on), `auto`, the backend that "auto" takes, and `hardware`, the fields of `Hardware`.
    """
    found = describe_machine()
    return found | _backends() if found["packages"]["torch"] else found


def _backends() -> dict[str, Any]:
    from .backends import KERNELS
    from .hardware import hardware_for

    backends = {}
    for name, kernels in KERNELS.items():
        reason = kernels.unavailable_reason()
        backends[name] = {"runs": reason is None, "reason": reason} | kernels.details()
    found = asdict(hardware_for("auto"))
    return {"backends": backends, "auto": found["backend"], "hardware": found}


def engine_version() -> str | None:
    """Return the version in the manifest of the extension around this package, else that of the installed package."""
    manifest = Path(__file__).parents[2] / "blender_manifest.toml"
    if manifest.is_file():
        return tomllib.loads(manifest.read_text(encoding="utf-8"))["version"]
    return _version("swag-splatting")


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
