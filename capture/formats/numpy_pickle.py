"""A `.npy` that holds a dictionary, read as data: NumPy saves such objects as a pickle, and a pickle is a
program that Python's own reader would run.

Here nothing that the file names is imported or called. The few names that NumPy's arrays need stand for the
inert classes below, which only keep what they are given; any other name is refused. Arrays are then made from
the kept bytes, for plain numbers only.
"""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from capture.errors import RecordingError

MAGIC = b"\x93NUMPY"
_DEEPEST = 50


class _Dtype:
    """numpy.dtype("f8"): the code is kept; of the state, the byte order."""

    def __init__(self, code: Any = "", *_flags: Any) -> None:
        self.code, self.order = str(code), "="

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, tuple) and len(state) > 1 and state[1] in ("<", ">", "|", "="):
            self.order = state[1]


class _Array:
    """An array to be: what its state said, never interpreted by NumPy itself."""

    def __init__(self, *_arguments: Any) -> None:
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Scalar:
    """A single number of NumPy's: dtype and bytes."""

    def __init__(self, dtype: Any = None, data: Any = b"") -> None:
        self.dtype, self.data = dtype, data


class _Buffer:
    """numpy's _frombuffer of protocol 5: bytes, dtype, shape, order."""

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments


class _Encoded:
    """Protocol 2 writes bytes as text to be encoded as latin-1; `__reduce__` data, not a call."""

    def __new__(cls, text: Any = "", encoding: Any = "latin1") -> Any:
        if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
            raise pickle.UnpicklingError("encodes something other than bytes")
        return text.encode("latin-1")


_NAMES: dict[tuple[str, str], type] = {
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _Array for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): _Scalar for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _Buffer for core in ("core", "_core")},
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _Encoded,
}


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        found = _NAMES.get((module, name))
        if found is None:
            told = "".join(c if c.isprintable() else "?" for c in f"{module}.{name}"[:80])
            raise pickle.UnpicklingError(f"names {told}, which no table of cameras needs")
        return found

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError("refers to an object that is kept elsewhere")


def read_object_array(path: Path) -> Any:
    """The object in a `.npy`: dictionaries, lists, text, numbers and numeric arrays. Raises RecordingError
    for anything else, without running it."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    stream = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(stream)
        read_header = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        _, _, dtype = read_header(stream)
    except ValueError as error:
        raise RecordingError(f"{path}: no .npy file ({error}); is it whole?") from error
    if dtype.kind != "O":
        raise RecordingError(f"{path}: holds an array of {dtype}, not a dictionary of cameras and pictures")
    try:
        return _plain(_Reader(stream, encoding="latin1").load())
    except RecursionError:
        reason = "is nested without end"
    except Exception as error:  # whatever a damaged pickle leads to: it is data of unknown origin
        reason = f"{type(error).__name__}: {error}"
    raise RecordingError(
        f"{path}: its pickle is not read ({reason}); is it the dataset's own file, and whole?"
    )


def _plain(value: Any, depth: int = 0) -> Any:
    """Inert objects as NumPy arrays and numbers, all the way down."""
    if depth > _DEEPEST:
        raise RecursionError
    if isinstance(value, dict):
        return {key: _plain(part, depth + 1) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part, depth + 1) for part in value]
    if isinstance(value, _Array):
        if not isinstance(value.state, tuple) or len(value.state) != 5:
            raise ValueError("an array without its values")
        _, shape, dtype, by_columns, data = value.state
        if isinstance(dtype, _Dtype) and dtype.code.startswith("O"):
            parts = [_plain(part, depth + 1) for part in data]
            return parts[0] if shape == () else parts
        return _numbers(data, dtype, shape, bool(by_columns))
    if isinstance(value, _Buffer):
        data, dtype, shape, order = value.arguments
        return _numbers(bytes(data), dtype, shape, order == "F")
    if isinstance(value, _Scalar):
        return _numbers(value.data, value.dtype, (1,), False)[0].item()
    return value


def _numbers(data: Any, dtype: Any, shape: Any, by_columns: bool) -> np.ndarray:
    if isinstance(data, str):
        data = data.encode("latin-1")
    if (
        not isinstance(dtype, _Dtype)
        or dtype.code[:1] not in "fiub"
        or not isinstance(data, bytes | bytearray)
    ):
        raise ValueError("an array of something other than numbers")
    order = "" if dtype.order == "|" else dtype.order
    flat = np.frombuffer(bytes(data), np.dtype(order + dtype.code))
    return flat.reshape([int(n) for n in shape], order="F" if by_columns else "C")
