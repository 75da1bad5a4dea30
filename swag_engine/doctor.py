"""What this machine has, and which backend a run would take. `python -m swag_engine.doctor` gives it as an event of
the worker's protocol, also where the engine's packages are missing."""

import json
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

    from .rasterize import cpu, cuda
    from .rasterize.backends import device_for
    from .rasterize.cpu_library import target

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
    manifest = Path(__file__).parents[1] / "blender_manifest.toml"
    if manifest.is_file():
        return tomllib.loads(manifest.read_text(encoding="utf-8"))["version"]
    return _version("swag-splatting")


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def describe(found: dict[str, Any]) -> str:
    """The findings in lines for people."""
    lines = [f"SWAG Splatting {found['engine']}, {found['system']}, Python {found['python']}, {found['cores']} cores"]
    lines += [f"  {name} {version or 'is missing'}" for name, version in found["packages"].items()]
    if "backends" not in found:
        return "\n".join(lines)
    cpu_backend, cuda_backend, torch_backend = (found["backends"][name] for name in ("cpu", "cuda", "torch"))
    details = {
        "cuda": f"{cuda_backend.get('device')}, {cuda_backend.get('memory_gb')} GB",
        "cpu": f"{cpu_backend['kernels']}, {cpu_backend['threads']} threads",
        "torch": f"on {torch_backend['device']}, slow",
    }
    for name, detail in details.items():
        backend = found["backends"][name]
        lines.append(f"backend {name}: {detail if backend['runs'] else 'does not run here: ' + backend['reason']}")
    lines.append(f"Training takes {found['auto']}.")
    return "\n".join(lines)


if __name__ == "__main__":
    print(json.dumps({"event": "result", **examine()}))
