"""What this machine has, and which backend a run would take. `python -m swag_engine.app.doctor` gives it as an event of
the worker's protocol, also where the engine's packages are missing."""

import json
from typing import Any

from ..kernels.machine import examine


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
