"""What this machine has, and which backend training would use.

`python -m swag_engine.app.doctor` prints it as an event of the worker's protocol, also where packages are missing.
"""

import json
from typing import Any

from ..kernels.machine import examine


def describe(found: dict[str, Any]) -> str:
    """Format the result of `examine` as text.

    Args:
        found: What `examine` returned.

    Returns:
        The lines that `doctor` prints.
    """
    lines = [f"SWAG Splatting {found['engine']}, {found['system']}, Python {found['python']}, {found['cores']} cores"]
    lines += [f"  {name} {version or 'is missing'}" for name, version in found["packages"].items()]
    if "backends" not in found:
        return "\n".join(lines)
    cpu_backend, cuda_backend, wgpu_backend, torch_backend = (
        found["backends"][name] for name in ("cpu", "cuda", "wgpu", "torch")
    )
    details = {
        "cuda": f"{cuda_backend.get('device')}, {cuda_backend.get('memory_gb')} GB",
        "cpu": f"{cpu_backend['kernels']}, {cpu_backend['threads']} threads",
        "wgpu": str(wgpu_backend["device"]),
        "torch": f"on {torch_backend['device']}, slow",
    }
    for name, detail in details.items():
        backend = found["backends"][name]
        lines.append(f"backend {name}: {detail if backend['runs'] else 'does not run here: ' + backend['reason']}")
    for adapter in wgpu_backend["adapters"]:
        sums = "adds floats atomically" if adapter["float_atomics"] else "adds floats by compare and swap"
        size = f"reads {adapter['largest_binding'] / 2**20:.0f} MiB at once"
        use = f"not used: {adapter['refused']}" if adapter["refused"] else "used"
        lines.append(f"  adapter {adapter['name']}, {adapter['api']}, {adapter['driver']}: {sums}, {size}, {use}")
    used = found["hardware"]
    memory = f", {used['memory'] / 1e9:.1f} GB" if used["memory"] else ""
    lines.append(f"Training uses {used['backend']} on {used['name']}{memory}.")
    return "\n".join(lines)


if __name__ == "__main__":
    print(json.dumps({"event": "result", **examine()}))
