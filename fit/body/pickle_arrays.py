"""What the permitted names in a body's pickle mean: numpy arrays, scipy's sparse matrices, chumpy's arrays.

`pickle_reader` leaves calls as records; here those of arrays become arrays, without numpy's, scipy's or
chumpy's own loaders (the last two need not be installed, and old module paths don't matter). Every size is
checked against what is really in the file before memory is asked for.
"""

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from .pickle_reader import Name, PickleRefused, Record, read_pickle

MAX_ELEMENTS = 100_000_000  # of one array; the largest of SMPL-X have 15 million
MAX_BYTES = 1_600_000_000  # of all arrays that one value needs
MAX_DEPTH = 24  # arrays inside arrays: views of views, lists of lists

_SPARSE_FORMATS = ("csc", "csr", "coo")
_ARRAY_CLASSES = {
    Name("numpy", "ndarray"),
    Name("numpy", "matrix"),
    Name("numpy.matrixlib.defmatrix", "matrix"),
}
_REBUILT = {Name(m, "_reconstruct") for m in ("numpy.core.multiarray", "numpy._core.multiarray")}
_SCALAR = {Name(m, "scalar") for m in ("numpy.core.multiarray", "numpy._core.multiarray")}
_FROM_BUFFER = {Name(m, "_frombuffer") for m in ("numpy.core.numeric", "numpy._core.numeric")}
_DTYPE = Name("numpy", "dtype")
_SPARSE = {
    Name(f"scipy.sparse.{mark}{kind}", f"{kind}_{what}"): kind
    for kind in _SPARSE_FORMATS
    for mark in ("", "_")
    for what in ("matrix", "array")
}
_NEW_OBJECT = {Name(m, "_reconstructor") for m in ("copyreg", "copy_reg")} | {
    Name(m, "__newobj__") for m in ("copyreg", "copy_reg")
}
_ENCODE = Name("_codecs", "encode")
_PLAIN_NAMES = ("object", "set", "frozenset", "dict", "list", "tuple", "bytes", "bytearray", "complex")
_PLAIN = {Name(m, n) for m in ("builtins", "__builtin__") for n in _PLAIN_NAMES}
_DICTIONARIES = {Name("collections", "OrderedDict"), Name("collections", "defaultdict")} | {
    name for name in _PLAIN if name.name == "dict"
}
PERMITTED: frozenset[Name] = frozenset(
    {*_ARRAY_CLASSES, *_REBUILT, *_SCALAR, *_FROM_BUFFER, _DTYPE, *_SPARSE, *_NEW_OBJECT, _ENCODE}
    | {*_PLAIN, *_DICTIONARIES}
)


def permit(name: Name) -> None:
    """Raise PickleRefused unless the name is in PERMITTED or of the package chumpy (all of whose objects stay
    records)."""
    if name not in PERMITTED and name.module != "chumpy" and not name.module.startswith("chumpy."):
        raise PickleRefused(
            f"names {name}, which no body file needs. A pickle can run programs; this one was not run"
        )


def read_mapping(data: bytes) -> Mapping[str, Any]:
    """The dictionary of a body's pickle; its values are for `array_of` and `text_of`. PickleRefused where
    there is none."""
    found = _as_dictionary(read_pickle(data, permit))
    if found is None:
        raise PickleRefused("holds no dictionary of arrays")
    return {k.decode("latin-1") if isinstance(k, bytes) else str(k): v for k, v in found.items()}


def _as_dictionary(value: Any) -> dict[Any, Any] | None:
    if isinstance(value, Record) and value.name in _DICTIONARIES:
        pairs = value.arguments[0] if value.arguments else []
        given = pairs if isinstance(pairs, list) else []
        two = [pair for pair in given if isinstance(pair, list | tuple) and len(pair) == 2]
        return {str(k): v for k, v in two if isinstance(k, str | bytes | int)} | value.items
    return value if isinstance(value, dict) else None


def text_of(value: Any) -> str:
    """Text stored as text, bytes or an array of one text."""
    if isinstance(value, str):
        return value
    if isinstance(value, bytes):
        return value.decode("latin-1")
    array = array_of(value)
    if array.size != 1 or array.dtype.kind not in "US":
        raise PickleRefused(f"holds {_called(value)} where text belongs")
    item = array.reshape(-1)[0]
    return item.decode("latin-1") if isinstance(item, bytes) else str(item)


def array_of(value: Any) -> np.ndarray:
    """The array that a value of a pickle stands for; sparse ones filled in. PickleRefused for all else."""
    return _Resolver().array(value)


class _Resolver:
    """Arrays of nested values. Each value is worked out once, and all that is made is counted: a small file
    can name the same list a thousand times, ten levels deep."""

    def __init__(self) -> None:
        self.depth, self.n_bytes = 0, 0
        self.known: dict[int, np.ndarray] = {}

    def array(self, value: Any) -> np.ndarray:
        if isinstance(value, np.ndarray):
            return value
        if id(value) in self.known:
            return self.known[id(value)]
        if self.depth >= MAX_DEPTH:
            raise PickleRefused(f"holds arrays inside arrays more than {MAX_DEPTH} deep")
        self.depth += 1
        array = self._made_of(value)
        self.depth -= 1
        if array.dtype.kind == "O":
            raise PickleRefused("holds a whole number too large for an array")
        self.known[id(value)] = array  # the caller keeps `value` alive, so its id stays its own
        return array

    def claim(self, n_bytes: int) -> None:
        self.n_bytes += n_bytes
        if self.n_bytes > MAX_BYTES:
            raise PickleRefused(f"claims arrays of more than {MAX_BYTES} bytes")

    def _made_of(self, value: Any) -> np.ndarray:
        if isinstance(value, bool | int | float | str | bytes):
            self.claim(4 * len(value) if isinstance(value, str | bytes) else 8)
            return np.array(value)
        if isinstance(value, list | tuple):
            return self._from_list(value)
        if isinstance(value, Record):
            name, arguments = _made(value)
            if name in _ARRAY_CLASSES:
                return self._dense_state(value.state)
            if name in _SCALAR and len(arguments) == 2:
                return self._from_bytes(arguments[1], _dtype(arguments[0]), (), "C")
            if name in _FROM_BUFFER and len(arguments) == 4:
                return self._from_bytes(
                    arguments[0], _dtype(arguments[1]), _shape(arguments[2]), arguments[3]
                )
            if name in _SPARSE:
                return self._filled(_SPARSE[name], _state_of(value, name))
            if name.module.split(".")[0] == "chumpy":
                return self._of_chumpy(name, _state_of(value, name))
        raise PickleRefused(f"holds {_called(value)} where an array belongs")

    def _from_list(self, values: list[Any] | tuple[Any, ...]) -> np.ndarray:
        """Nested lists of equal lengths."""
        if all(type(v) in (bool, int, float) for v in values):
            self.claim(8 * len(values))
            return np.array(values)
        children = [self.array(value) for value in values]
        if not children[0].size:
            raise PickleRefused("holds a list of empty lists")
        if len({(c.shape, c.dtype.kind in "US") for c in children}) > 1:
            raise PickleRefused("holds a list whose entries have different lengths")
        self.claim(len(children) * max(c.nbytes for c in children))
        return np.stack(children)

    def _from_bytes(self, data: Any, dtype: np.dtype, shape: tuple[int, ...], order: Any) -> np.ndarray:
        if dtype.kind == "O":
            raise PickleRefused("holds objects as raw bytes")
        raw = _buffer(data)
        n_elements = math.prod(shape)
        if len(raw) != n_elements * dtype.itemsize or not dtype.itemsize:
            raise PickleRefused(f"holds an array of shape {shape} and type {dtype} in {len(raw)} bytes")
        self.claim(len(raw))
        return np.frombuffer(raw, dtype).reshape(shape, order="F" if order == "F" else "C").copy()

    def _dense_state(self, state: Any) -> np.ndarray:
        """numpy's array state: (version, shape, type, column order, bytes or list of objects)."""
        if not isinstance(state, tuple) or len(state) not in (4, 5):
            raise PickleRefused("holds an array without content")
        shape_value, dtype_value, by_column, data = state[-4:]
        dtype, shape = _dtype(dtype_value), _shape(shape_value)
        if dtype.kind != "O":
            return self._from_bytes(data, dtype, shape, "F" if by_column else "C")
        if not isinstance(data, list) or len(data) != math.prod(shape):
            raise PickleRefused("holds an array of objects without its objects")
        if len(data) == 1:  # how numpy stores one sparse matrix or dictionary in an .npz
            return self.array(data[0])
        array = self._from_list(data)
        return array.reshape((*shape, *array.shape[1:]))

    def _filled(self, kind: str, state: dict[Any, Any]) -> np.ndarray:
        """A sparse matrix with its zeros. Formats: scipy's csc, csr (data, indices, indptr) and coo."""
        shape = _shape(state.get("_shape", state.get("shape")))
        data = self.array(state.get("data")).reshape(-1)
        if len(shape) != 2 or data.dtype.kind not in "biuf":
            raise PickleRefused(f"holds a sparse matrix of shape {shape} and type {data.dtype}")
        if kind == "coo":
            pair = state.get("coords") or (state.get("row"), state.get("col"))
            if not isinstance(pair, tuple) or len(pair) != 2:
                raise PickleRefused("holds a sparse matrix (coo) without its coordinates")
            rows, columns = (self._whole(v) for v in pair)
        else:
            inner, start = self._whole(state.get("indices")), self._whole(state.get("indptr"))
            n_outer = shape[1] if kind == "csc" else shape[0]
            n_inner = min(len(inner), len(data))
            if len(start) != n_outer + 1 or start[0] or (np.diff(start) < 0).any() or start[-1] > n_inner:
                raise PickleRefused(f"holds a sparse matrix ({kind}) with wrong pointers")
            inner, data = inner[: start[-1]], data[: start[-1]]
            outer = np.repeat(np.arange(n_outer), np.diff(start))
            rows, columns = (inner, outer) if kind == "csc" else (outer, inner)
        for index, size in ((rows, shape[0]), (columns, shape[1])):
            if len(index) != len(data) or (len(index) and (index.min() < 0 or index.max() >= size)):
                raise PickleRefused(f"holds a sparse matrix ({kind}) with entries outside its {shape}")
        self.claim(8 * math.prod(shape))
        dense = np.zeros(shape, np.result_type(data.dtype, np.float32))
        np.add.at(dense, (rows, columns), data)
        return dense

    def _whole(self, value: Any) -> np.ndarray:
        array = self.array(value).reshape(-1)
        if array.dtype.kind not in "iu" and array.size:
            raise PickleRefused(f"holds indices of type {array.dtype}")
        return array.astype(np.int64)

    def _of_chumpy(self, name: Name, state: dict[Any, Any]) -> np.ndarray:
        """A chumpy array: its values `x`, or a view (`a` taken at `idxs`, in `preferred_shape`)."""
        if "x" in state:
            return self.array(state["x"])
        if "a" not in state or "idxs" not in state:
            raise PickleRefused(f"holds a chumpy expression {name} instead of numbers; store its values (.r)")
        source, index = self.array(state["a"]).reshape(-1), self._whole(state["idxs"])
        if len(index) and (index.min() < 0 or index.max() >= len(source)):
            raise PickleRefused(f"holds a chumpy view {name} that reaches outside its array")
        self.claim(index.nbytes)
        taken = source[index]
        if state.get("preferred_shape") is None:
            return taken
        shape = _shape(tuple(self.array(state["preferred_shape"]).reshape(-1).tolist()))
        if math.prod(shape) != len(taken):
            raise PickleRefused(f"holds a chumpy view {name} of {len(taken)} values for a shape {shape}")
        return taken.reshape(shape)


def _called(value: Any) -> str:
    if isinstance(value, Record):
        return f"an object {_made(value)[0]}"
    return "a dictionary" if isinstance(value, dict) else f"a value of type {type(value).__name__}"


def _made(record: Record) -> tuple[Name, tuple[Any, ...]]:
    """Class and arguments of an object, however its making is written."""
    if record.name in _REBUILT | _NEW_OBJECT and record.arguments and isinstance(record.arguments[0], Name):
        return record.arguments[0], record.arguments[1:]
    return record.name, record.arguments


def _state_of(record: Record, name: Name) -> dict[Any, Any]:
    if not isinstance(record.state, dict):
        raise PickleRefused(f"holds an object {name} without content")
    return record.state


def _dtype(value: Any) -> np.dtype:
    """A plain type: numbers, truth values, text or objects; no structures."""
    if not isinstance(value, Record) or value.name != _DTYPE or not value.arguments:
        raise PickleRefused("holds an array without a type")
    name, state = value.arguments[0], value.state
    if not isinstance(name, str) or not re.fullmatch("[biufcSUO?][0-9]{0,6}", name):
        raise PickleRefused("holds an array of a type other than numbers and text")
    turned = isinstance(state, tuple) and len(state) > 1 and state[1] == ">"
    try:
        return np.dtype(name).newbyteorder(">" if turned else "<")
    except TypeError as error:
        raise PickleRefused(f"holds an array of an unknown type ({name})") from error


def _shape(value: Any) -> tuple[int, ...]:
    sizes = (value,) if isinstance(value, int) else value
    if not isinstance(sizes, tuple) or len(sizes) > 8 or not all(isinstance(n, int) for n in sizes):
        raise PickleRefused("holds an array without a proper shape")
    if min(sizes, default=0) < 0 or math.prod(sizes) > MAX_ELEMENTS:
        shown = " x ".join(map(str, sizes))[:60]
        raise PickleRefused(f"claims an array of {shown} elements; at most {MAX_ELEMENTS} are read")
    return sizes


def _buffer(value: Any) -> bytes:
    """Bytes, however they are written: Python 3 encodes them as text for old protocols."""
    if isinstance(value, Record) and (value.name == _ENCODE or value.name.name in ("bytes", "bytearray")):
        value = value.arguments[0] if value.arguments else b""
    if isinstance(value, str):
        try:
            return value.encode("latin-1")
        except UnicodeEncodeError as error:
            raise PickleRefused("holds an array whose bytes are damaged") from error
    if isinstance(value, bytes):
        return value
    raise PickleRefused("holds an array without its bytes")
