"""Body files opened safely: a pickle or an .npz as named values, of which arrays are made one by one.

Which of the two a file is tells its content, not its name. Nothing of a file is ever run (`pickle_reader`),
and no array is made that the file does not hold (an .npz packs: sizes are checked first).
"""

import io
import math
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .pickle_arrays import MAX_BYTES, array_of, permit, read_mapping, text_of
from .pickle_reader import PickleRefused, read_pickle

MAX_FILE_BYTES = 2 << 30
SUFFIXES = (".npz", ".pkl", ".pickle")
_ZIP, _NPY = b"PK", b"\x93NUMPY"


class BodyModelError(ValueError):
    """A body that cannot be had: one or two lines for the user saying what was found and what to do."""


class BodyArchive:
    """The named values of one file; every method raises BodyModelError with the file's name."""

    def __init__(self, path: Path, values: Mapping[str, Callable[[], Any]]) -> None:
        self.path, self._values = path, values

    @property
    def names(self) -> list[str]:
        """What the file holds, sorted."""
        return sorted(self._values)

    @property
    def listed(self) -> str:
        """The names for a message: not too many, and on one line."""
        shown = ["".join(c if c.isprintable() else "?" for c in name[:40]) for name in self.names[:20]]
        more = len(self.names) - len(shown)
        return ", ".join(shown) + (f" and {more} more" if more else "") if shown else "nothing"

    def array(self, name: str) -> np.ndarray:
        """The array of this name, sparse ones filled in."""
        return self._guarded(name, array_of)

    def text(self, name: str) -> str:
        """The text of this name."""
        return self._guarded(name, text_of)

    def _guarded(self, name: str, make: Callable[[Any], Any]) -> Any:
        try:
            return make(self._values[name]())
        except PickleRefused as error:
            raise BodyModelError(f"{self.path}: {name} {error}.") from error
        except _DAMAGE as error:
            raise BodyModelError(
                f"{self.path}: {name} cannot be read ({error}). Copy or download the file again."
            ) from error


_DAMAGE = (OSError, EOFError, ValueError, RuntimeError, NotImplementedError, MemoryError, zlib.error,
           zipfile.BadZipFile, SyntaxError, RecursionError, TypeError)  # fmt: skip


def open_archive(path: Path) -> BodyArchive:
    """The values of an .npz or a pickle. Raises BodyModelError where it is neither, damaged or hostile."""
    if not path.exists():
        raise BodyModelError(
            f"{path}: no such body file. Use free:neutral, free:female, free:male, "
            f"or the path of an SMPL-format .npz or .pkl."
        )
    if path.is_dir() or path.suffix.lower() not in SUFFIXES:
        found = "a folder" if path.is_dir() else path.suffix or "without a suffix"
        raise BodyModelError(
            f"{path}: body files are read as .npz or .pkl, this is {found}. "
            f"Give the file of an SMPL, SMPL-H or SMPL-X body."
        )
    n_bytes = path.stat().st_size
    if n_bytes > MAX_FILE_BYTES:
        raise BodyModelError(
            f"{path}: has {n_bytes / 1e9:.1f} GB; body files of up to {MAX_FILE_BYTES / 1e9:.1f} GB are read."
        )
    with path.open("rb") as stream:
        is_zip = stream.read(2) == _ZIP
    return _open_zip(path) if is_zip else _open_pickle(path)


def _open_pickle(path: Path) -> BodyArchive:
    try:
        values = read_mapping(path.read_bytes())
    except PickleRefused as error:
        raise BodyModelError(f"{path}: this pickle {error}.") from error
    return BodyArchive(path, {name: (lambda value=value: value) for name, value in values.items()})


def _open_zip(path: Path) -> BodyArchive:
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename: info for info in archive.infolist()}
    except _DAMAGE as error:
        raise BodyModelError(
            f"{path}: not a readable .npz ({error}). Copy or download the file again."
        ) from error
    loaders = {
        name.removesuffix(".npy"): (lambda info=info: _read_member(path, info))
        for name, info in members.items()
    }
    return BodyArchive(path, loaders)


def _read_member(path: Path, info: zipfile.ZipInfo) -> Any:
    """One .npy inside an .npz: an array, or what a pickled one stands for (PickleRefused where nothing)."""
    if info.file_size > MAX_BYTES:
        raise PickleRefused(f"unpacks to {info.file_size} bytes; at most {MAX_BYTES} are read")
    with zipfile.ZipFile(path) as archive, archive.open(info) as member:
        data = member.read(info.file_size)
    if data[:6] != _NPY:
        raise PickleRefused("is not an array in numpy's format")
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, by_column, dtype = np.lib.format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, by_column, dtype = np.lib.format.read_array_header_2_0(stream)
    else:
        raise PickleRefused(
            f"is in version {version[0]}.{version[1]} of numpy's format; 1.0 and 2.0 are read"
        )
    if dtype.hasobject:
        return read_pickle(data[stream.tell() :], permit)
    if dtype.kind not in "biufcSU" or dtype.shape:
        raise PickleRefused("is an array of a type other than numbers and text")
    n_elements = math.prod(shape)
    if n_elements * dtype.itemsize != len(data) - stream.tell():
        raise PickleRefused(
            f"is announced with shape {shape}, but {len(data) - stream.tell()} bytes are there"
        )
    flat = np.frombuffer(data, dtype, n_elements, stream.tell())
    return flat.reshape(shape, order="F" if by_column else "C").copy()
