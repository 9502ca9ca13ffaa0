"""OpenCV FileStorage files (YAML, XML, JSON) and plain JSON as dictionaries, lists, numbers and arrays.

OpenCV's own parser reads YAML and XML; JSON goes through Python's, which also takes plain nested lists.
Matrices (`rows`, `cols`, `data`, with OpenCV's tag or without, as ROS writes them) become (rows cols) arrays.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from capture.errors import RecordingError
from capture.formats.limits import read_text


def read_tree(path: Path) -> dict[str, Any]:
    """The file's root. Raises RecordingError for a file that does not parse or whose root is no map."""
    text = read_text(path)
    content: Any
    if text.lstrip().startswith(("{", "[")):
        try:
            content = _with_matrices(json.loads(text), path)
        except ValueError as error:
            raise RecordingError(f"{path}: not a JSON file ({error}); is it whole?") from error
    else:
        content = _parsed(text, path)
    if not isinstance(content, dict):
        raise RecordingError(f"{path}: holds a list where named values are due; is it a calibration?")
    return content


def _parsed(text: str, path: Path) -> Any:
    if not text.lstrip().startswith(("<", "%YAML")):
        text = "%YAML:1.0\n---\n" + text.removeprefix("---\n")  # ROS and others leave the directive out
    storage = cv2.FileStorage()
    try:
        opened = storage.open(text.replace("\r\n", "\n"), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        if not opened:
            raise RecordingError(f"{path}: OpenCV cannot parse it; is the file whole?")
        return _value(storage.root(), path)
    except (cv2.error, SystemError) as error:
        reason = str(error).rsplit("error:", maxsplit=1)[-1].strip().splitlines()[0]
        raise RecordingError(f"{path}: OpenCV cannot parse it ({reason}); is the file whole?") from error
    finally:
        storage.release()


def _value(node: Any, path: Path) -> Any:
    if node.isMap():
        return _matrix({key: _value(node.getNode(key), path) for key in node.keys()}, path)  # noqa: SIM118
    if node.isSeq():
        return [_value(node.at(k), path) for k in range(node.size())]
    if node.isString():
        return node.string()
    return float(node.real()) if node.isReal() or node.isInt() else None


def _with_matrices(value: Any, path: Path) -> Any:
    if isinstance(value, dict):
        return _matrix({str(key): _with_matrices(part, path) for key, part in value.items()}, path)
    if isinstance(value, list):
        return [_with_matrices(part, path) for part in value]
    return value


def _matrix(value: dict[str, Any], path: Path) -> Any:
    if {"rows", "cols", "data"} <= set(value):
        shape = [value["rows"], value["cols"]]
    elif {"sizes", "data"} <= set(value):  # OpenCV 5 of arrays that are no matrices
        shape = list(np.ravel(value["sizes"]))
    else:
        return value
    try:
        return np.array(value["data"], dtype=np.float64).reshape([int(n) for n in shape])
    except (TypeError, ValueError, OverflowError) as error:
        told = " x ".join(map(str, shape))
        raise RecordingError(
            f"{path}: a matrix of {told} does not hold that many numbers ({error}); is the file whole?"
        ) from error
