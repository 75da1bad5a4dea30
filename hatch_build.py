"""What building the package does: takes the dependencies from requirements.txt and compiles the kernels."""

import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface


class Requirements(MetadataHookInterface):
    """requirements.txt is what Blender's Install Engine installs too: the list stands once."""

    def update(self, metadata: dict[str, Any]) -> None:
        metadata["dependencies"] = (Path(self.root) / "requirements.txt").read_text(encoding="utf-8").split()


class KernelBuildHook(BuildHookInterface):
    """The wheel depends on the platform, not on the Python version: the kernels are loaded by ctypes.

    On Linux they need glibc 2.17 or later, as the targets of kernels/build.py say.
    """

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        script = Path(self.root) / "swag_engine" / "kernels" / "build.py"
        subprocess.run([sys.executable, str(script)], check=True)
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_").replace("linux_", "manylinux_2_17_")
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform}"
        build_data["artifacts"].append("swag_engine/kernels/lib/*")
