"""Pretrained networks in ONNX files, on the CPU."""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime  # type: ignore[import-untyped]

from ..base.errors import InputError
from ..base.threads import available_cores

FLOAT32 = "tensor(float)"
"""onnxruntime's name of float32 tensors."""
NUMBERS = {FLOAT32: np.float32, "tensor(int64)": np.int64, "tensor(int32)": np.int32}
"""onnxruntime's names of the types of tensors that can be inputs -> dtype."""
Shape = tuple[int | None, ...]
"""Shape of a tensor. None stands for any size; () for one number, of whatever rank the file gives it."""


class Network:
    """A network of float32 tensors in an ONNX file. ONNX files hold no code that would be run, unlike pickled weights.

    Args:
        path: The file.
        kind: What it is, for messages ("an inverse depth network").
        inputs: Shapes that its inputs must have, in order.
        output: Shapes, one of which its first output must have.

    Raises:
        InputError: If the file is absent, not an ONNX file, or another network.
    """

    def __init__(self, path: Path, kind: str, inputs: Sequence[Shape], output: Sequence[Shape]) -> None:
        self.path, self.kind, self.output = path, kind, output
        self.session = _session(path, kind)
        found, made = self.session.get_inputs(), self.session.get_outputs()[0]
        self.inputs = [_shape(tensor) for tensor in found]
        fits = len(inputs) == len(found) and all(map(_fits, self.inputs, inputs))
        # onnxruntime gives an output of unknown rank the shape of a number; its shape is checked when the network runs.
        fits = fits and (not made.shape or any(_fits(_shape(made), shape) for shape in output))
        needed = f"{' or '.join(map(_shape_text, output))} from {', '.join(map(_shape_text, inputs))}"
        if not fits or any(tensor.type != FLOAT32 for tensor in [*found, made]):
            raise InputError(
                f"{path} is not {kind}: it makes {_describe([made])} from {_describe(found)}, "
                f"where {needed}, all float32, is needed."
            )

    def __call__(self, *arrays: np.ndarray) -> np.ndarray:
        """Run the network.

        Args:
            *arrays: Inputs, float32, in the order of the file.

        Returns:
            The first output, float32.

        Raises:
            InputError: If the network fails, or its output has another shape or is not finite.
        """
        tensors = self.session.get_inputs()
        feed = {
            tensor.name: array.reshape(len(tensor.shape) * [1]) if array.size == 1 else array
            for tensor, array in zip(tensors, arrays, strict=True)
        }
        made = _run(self.session, self.path, [self.session.get_outputs()[0].name], feed)[0]
        if not any(_fits(made.shape, shape) for shape in self.output):
            raise InputError(
                f"{self.path} is not {self.kind}: its output is {made.shape}, and "
                f"{' or '.join(map(_shape_text, self.output))} is needed."
            )
        if not np.isfinite(made).all():
            raise InputError(f"{self.path} makes numbers that are not finite: get it again or choose another file.")
        return made


class Graph:
    """A network with named inputs and outputs of several types in an ONNX file.

    Exporters name tensors differently: inputs or outputs with other names are matched in the order of the file, where
    their number agrees.

    Args:
        path: The file.
        kind: What it is, for messages.
        inputs: Name -> shape of the inputs, None for any shape.
        outputs: Names of the outputs.
        optional: Names of inputs that the file may have as well.

    Raises:
        InputError: If the file is absent, not an ONNX file, or another network.
    """

    def __init__(
        self,
        path: Path,
        kind: str,
        inputs: Mapping[str, Shape | None],
        outputs: Sequence[str],
        optional: Sequence[str] = (),
    ) -> None:
        self.path, self.kind = path, kind
        self.session = _session(path, kind)
        found, made = self.session.get_inputs(), self.session.get_outputs()
        needed = [tensor for tensor in found if tensor.name not in optional]
        self._inputs = _matched(list(inputs), needed)
        self._inputs |= {tensor.name: tensor for tensor in found if tensor.name in optional}
        self._outputs = _matched(outputs, made)
        self.shapes: dict[str, Shape] = {name: _shape(tensor) for name, tensor in self._inputs.items()}
        fits = len(needed) == len(inputs) and all(
            name in self.shapes and (shape is None or _fits(self.shapes[name], shape)) for name, shape in inputs.items()
        )
        known = all(tensor.type in NUMBERS for tensor in found)
        if not fits or not known or len(self._outputs) != len(outputs):
            wanted = ", ".join(
                name if shape is None else f"{name} {_shape_text(shape)}" for name, shape in inputs.items()
            )
            raise InputError(
                f"{path} is not {kind}: it makes {_describe(made)} from {_describe(found)}, where {', '.join(outputs)} "
                f"from {wanted} is needed."
            )

    def __call__(self, **arrays: np.ndarray) -> dict[str, np.ndarray]:
        """Run the network.

        Args:
            **arrays: Inputs by name; inputs that the file does not have are ignored.

        Returns:
            Outputs by name; they may hold infinities, which some networks use as masks.

        Raises:
            InputError: If the network fails or an output has a NaN.
        """
        feed = {
            tensor.name: arrays[name].astype(NUMBERS[tensor.type], copy=False) for name, tensor in self._inputs.items()
        }
        made = _run(self.session, self.path, [tensor.name for tensor in self._outputs.values()], feed)
        if any(np.isnan(array).any() for array in made):
            raise InputError(f"{self.path} makes what is not a number: get it again or choose another file.")
        return dict(zip(self._outputs, made, strict=True))


def _session(path: Path, kind: str) -> Any:
    """Open a file; it runs on all available cores, with threads that sleep while they wait, so that others can work."""
    if not path.is_file():
        raise InputError(f"There is no file {path}: save {kind} there as an ONNX file, or choose another file.")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # errors are raised, and warnings are not for users
    options.intra_op_num_threads = available_cores()
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        for tensor in [*session.get_inputs(), *session.get_outputs()]:
            _ = tensor.name, tensor.shape, tensor.type  # raises where these are not UTF-8
        return session
    except Exception as error:  # onnxruntime's errors have no base class of their own
        raise InputError(
            f"{path} cannot be opened as an ONNX file ({_cause(error)}): get it again or choose another file."
        ) from error


def _run(session: Any, path: Path, outputs: Sequence[str], feed: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Run a session; raises InputError where that fails."""
    try:
        return list(session.run(list(outputs), dict(feed)))
    except Exception as error:  # onnxruntime's errors have no base class of their own
        sizes = ", ".join(str(array.shape) for array in feed.values() if array.size > 1)
        raise InputError(f"{path} cannot work on an input of {sizes} ({_cause(error)}).") from error


def _matched(names: Sequence[str], tensors: Sequence[Any]) -> dict[str, Any]:
    """Return tensors by the names wanted: those with these names, else all in their order where the number agrees."""
    by_name = {tensor.name: tensor for tensor in tensors}
    if all(name in by_name for name in names):
        return {name: by_name[name] for name in names}
    return dict(zip(names, tensors, strict=True)) if len(names) == len(tensors) else {}


def _shape(tensor: Any) -> Shape:
    return tuple(size if isinstance(size, int) else None for size in tensor.shape)


def _fits(shape: Shape, wanted: Shape) -> bool:
    """Return whether the sizes agree where both are known."""
    if not wanted:
        return all(size == 1 for size in shape)
    return len(shape) == len(wanted) and all(
        size == needed or None in (size, needed) for size, needed in zip(shape, wanted, strict=True)
    )


def _shape_text(shape: Shape) -> str:
    return f"({', '.join('any' if size is None else str(size) for size in shape)})" if shape else "one number"


def _describe(tensors: Sequence[Any]) -> str:
    return ", ".join(
        f"{tensor.name} {_shape_text(_shape(tensor))} {'float32' if tensor.type == FLOAT32 else tensor.type}"
        for tensor in tensors
    )


def _cause(error: Exception) -> str:
    """Return the part of onnxruntime's message that is meant for people, on one line."""
    words = str(error).split(" : ", 3)[-1].split("failed:", 1)[-1]
    return textwrap.shorten(words, 300, placeholder=" ...").rstrip(".")
