"""Pretrained networks in ONNX files, on the CPU."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime  # type: ignore[import-untyped]
import torch

from ..errors import InputError

FLOAT32 = "tensor(float)"  # in onnxruntime's words
Shape = tuple[int | None, ...]
"""None stands for any size; () for one number, of whatever rank the file gives it."""


class Network:
    """A network of float32 tensors in an ONNX file. ONNX files hold no code to run, unlike pickled weights."""

    def __init__(self, path: Path, kind: str, inputs: Sequence[Shape], output: Sequence[Shape]) -> None:
        """Open the file at `path`, whose inputs must have the shapes `inputs`, in order, and whose first output one of
        the shapes `output`. `kind` names it in messages ("an inverse depth network").

        It runs on as many threads as torch uses, which sleep while they wait: other work shares the cores.
        Raises InputError when the file is absent, no ONNX file, or a network of another kind.
        """
        self.path, self.kind, self.output = path, kind, output
        if not path.is_file():
            raise InputError(f"There is no file {path}: put {kind} there as an ONNX file, or choose another file.")
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4  # what goes wrong is raised; warnings are not for users
        options.intra_op_num_threads = torch.get_num_threads()
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self.session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors have no base class of their own
            raise InputError(
                f"{path} cannot be opened as an ONNX file ({_cause(error)}): get it again or choose another file."
            ) from error
        found, made = self.session.get_inputs(), self.session.get_outputs()[0]
        self.inputs = [_shape(tensor) for tensor in found]
        fits = len(inputs) == len(found) and all(map(_fits, self.inputs, inputs))
        # onnxruntime gives an output of unknown rank the shape of a number; such a one is judged when the network runs.
        fits = fits and (not made.shape or any(_fits(_shape(made), shape) for shape in output))
        needed = f"{' or '.join(map(_words, output))} from {', '.join(map(_words, inputs))}"
        if not fits or any(tensor.type != FLOAT32 for tensor in [*found, made]):
            raise InputError(
                f"{path} is not {kind}: it makes {_describe([made])} from {_describe(found)}, "
                f"where {needed}, all float32, is needed."
            )

    def __call__(self, *arrays: np.ndarray) -> np.ndarray:
        """The first output for float32 inputs, in the order of the file. Raises InputError when the network fails, or
        its output has none of the expected shapes or is not finite."""
        tensors = self.session.get_inputs()
        feed = {
            tensor.name: array.reshape(len(tensor.shape) * [1]) if array.size == 1 else array
            for tensor, array in zip(tensors, arrays, strict=True)
        }
        try:
            made = self.session.run([self.session.get_outputs()[0].name], feed)[0]
        except Exception as error:  # onnxruntime's errors have no base class of their own
            sizes = ", ".join(str(array.shape) for array in arrays if array.size > 1)
            raise InputError(f"{self.path} cannot work on an input of {sizes} ({_cause(error)}).") from error
        if not any(_fits(made.shape, shape) for shape in self.output):
            raise InputError(
                f"{self.path} is not {self.kind}: its output is {made.shape}, and "
                f"{' or '.join(map(_words, self.output))} is needed."
            )
        if not np.isfinite(made).all():
            raise InputError(f"{self.path} makes numbers that are not finite: get it again or choose another file.")
        return made


def _shape(tensor: Any) -> Shape:
    return tuple(size if isinstance(size, int) else None for size in tensor.shape)


def _fits(shape: Shape, wanted: Shape) -> bool:
    """Whether sizes that both know agree."""
    if not wanted:
        return all(size == 1 for size in shape)
    return len(shape) == len(wanted) and all(
        size == needed or None in (size, needed) for size, needed in zip(shape, wanted, strict=True)
    )


def _words(shape: Shape) -> str:
    return f"({', '.join('any' if size is None else str(size) for size in shape)})" if shape else "one number"


def _describe(tensors: Sequence[Any]) -> str:
    return ", ".join(
        f"{tensor.name} {_words(_shape(tensor))} {'float32' if tensor.type == FLOAT32 else tensor.type}"
        for tensor in tensors
    )


def _cause(error: Exception) -> str:
    """The part of onnxruntime's message that is meant for people, on one line."""
    words = str(error).split(" : ", 3)[-1].split("failed:", 1)[-1]
    return textwrap.shorten(words, 300, placeholder=" ...").rstrip(".")
