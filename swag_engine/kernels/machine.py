"""Describe this machine: system, packages, and which backends can run."""

import os
import platform
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGES = (
    "torch", "numpy", "scipy", "pycolmap", "opencv-contrib-python-headless", "onnxruntime", "safetensors", "tyro",
    "rich", "platformdirs", "matplotlib",
)  # fmt: skip
"""Those of requirements.txt."""


def examine() -> dict[str, Any]:
    """System, packages (None for one that is missing), and for each backend whether it runs or why not.

    Where torch is missing there are neither `backends` nor `auto`.
    """
    packages = {name: _version(name) for name in PACKAGES}
    found = {
        "system": f"{platform.system()} {platform.machine()}",
        "engine": engine_version(),
        "python": platform.python_version(),
        "cores": os.cpu_count(),
        "packages": packages,
    }
    return found | _backends() if packages["torch"] else found


def _backends() -> dict[str, Any]:
    import torch

    from ..kernels import cpu, cuda
    from ..kernels.backends import device_for
    from ..kernels.cpu_library import target

    chosen = target()
    backends: dict[str, dict[str, Any]] = {
        "cpu": {"runs": cpu.reason() is None, "reason": cpu.reason(), "threads": torch.get_num_threads()},
        "cuda": {"runs": cuda.reason() is None, "reason": cuda.reason()},
        "torch": {"runs": True, "reason": None, "device": str(device_for("torch"))},
    }
    backends["cpu"]["kernels"] = chosen.path.name if chosen else None
    if cuda.reason() is None:
        properties = torch.cuda.get_device_properties(torch.cuda.current_device())
        backends["cuda"] |= {
            "device": properties.name,
            "memory_gb": round(properties.total_memory / 1e9, 1),
            "architecture": f"sm_{properties.major}{properties.minor}",
        }
    auto = next(name for name in ("cuda", "cpu", "torch") if backends[name]["runs"])
    return {"backends": backends, "auto": auto}


def engine_version() -> str | None:
    """The version in the manifest of the extension around this package, else of the package that pip installed."""
    manifest = Path(__file__).parents[2] / "blender_manifest.toml"
    if manifest.is_file():
        return tomllib.loads(manifest.read_text(encoding="utf-8"))["version"]
    return _version("swag-splatting")


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
