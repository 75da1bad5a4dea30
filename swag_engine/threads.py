"""How torch's threads wait for each other."""

import os


def wait_politely() -> None:
    """Let waiting threads sleep instead of spin. Call before torch is imported.

    Where other work shares the cores (Blender itself, above all), spinning threads halve the speed of training.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
