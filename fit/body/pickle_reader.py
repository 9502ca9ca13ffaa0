"""Pickles read as data: the stack machine of the format, without the part that calls anything.

Body files of the SMPL family are pickles, and a pickle is a program: Python's own reader imports and calls
what the file names. This one never does. Whatever a file names becomes a `Name`, whatever it would call
becomes a `Record` (name, arguments, state), and `pickle_arrays` says what the few permitted ones mean. Names
outside its list are refused as soon as they are read.

Protocols 0 to 5 (opcodes: the commented list in Python's standard module `pickletools`). Text of Python 2 is
decoded as latin-1, which keeps every byte.
"""

import codecs
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

MAX_STEPS = 6_000_000  # a body file takes a few hundred; lists instead of arrays may take a few million
MAX_INTEGER_BYTES = 64
_MARK = object()


class PickleRefused(ValueError):
    """This pickle is not read: the text says what was found in it."""


@dataclass(frozen=True)
class Name:
    """Something that the file names: never imported."""

    module: str
    name: str

    def __str__(self) -> str:
        whole = f"{self.module}.{self.name}"  # of unknown origin: kept short and on one line
        return "".join(c if c.isprintable() else "?" for c in whole[:80])


@dataclass(eq=False)
class Record:
    """A call that the file asks for and does not get: what would be called, with what, and what the made
    object would then be filled with."""

    name: Name
    arguments: tuple[Any, ...]
    state: Any = None
    items: dict[Any, Any] = field(default_factory=dict)


def read_pickle(data: bytes, permit: Callable[[Name], None]) -> Any:
    """The one object of a pickle, as None, numbers, text, bytes, lists (also for sets), tuples, dictionaries,
    `Name` and `Record`. `permit` raises PickleRefused for a name that is not wanted.

    Raises PickleRefused for everything that such a file has no need of, and for damaged ones. Memory and time
    are bounded by the size of `data` and MAX_STEPS.
    """
    machine = _Machine(data, permit)
    try:
        return machine.run()
    except PickleRefused:
        raise
    except (IndexError, KeyError, struct.error, ValueError, TypeError, OverflowError) as error:
        raise PickleRefused(
            f"is damaged or not a pickle (byte {machine.at} of {len(data)}: {type(error).__name__})"
        ) from error


class _Machine:
    def __init__(self, data: bytes, permit: Callable[[Name], None]) -> None:
        self.data, self.permit = data, permit
        self.at = 0
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def run(self) -> Any:
        for _ in range(MAX_STEPS):
            code = self.take(1)[0]
            if code == ord("."):
                return self.stack.pop()
            step = _STEPS.get(code)
            if step is None:
                if code in _REFUSED:
                    raise PickleRefused(f"uses {_REFUSED[code]}, which no body file needs")
                raise PickleRefused(f"is not a pickle, or damaged (byte {self.at - 1} is {code:#04x})")
            step(self)
        raise PickleRefused(f"is a program of more than {MAX_STEPS} steps, which no body file needs")

    def take(self, n: int) -> bytes:
        stop = self.at + n
        if n < 0 or stop > len(self.data):
            raise PickleRefused(
                f"ends early: {n} bytes are announced at byte {self.at}, {len(self.data) - self.at} are there"
            )
        part = self.data[self.at : stop]
        self.at = stop
        return part

    def line(self) -> bytes:
        stop = self.data.find(b"\n", self.at)
        if stop < 0:
            raise PickleRefused(f"ends early: no end of the line that begins at byte {self.at}")
        part = self.data[self.at : stop]
        self.at = stop + 1
        return part.removesuffix(b"\r")

    def number(self, layout: str) -> Any:
        return struct.unpack(layout, self.take(struct.calcsize(layout)))[0]

    def push(self, value: Any) -> None:
        self.stack.append(value)

    def pop(self) -> Any:
        value = self.stack.pop()
        if value is _MARK:
            raise PickleRefused(f"is damaged (byte {self.at}: a mark where a value belongs)")
        return value

    def since_mark(self) -> list[Any]:
        start = len(self.stack) - 1
        while self.stack[start] is not _MARK:
            start -= 1
            if start < 0:
                raise PickleRefused(f"is damaged (byte {self.at}: no mark)")
        values = self.stack[start + 1 :]
        del self.stack[start:]
        return values

    def named(self, module: Any, name: Any) -> Name:
        if not isinstance(module, str) or not isinstance(name, str):
            raise PickleRefused("names something by other than text")
        found = Name(module, name)
        self.permit(found)
        return found

    def call(self, what: Any, arguments: Any) -> None:
        if not isinstance(what, Name) or not isinstance(arguments, tuple):
            raise PickleRefused("calls something that is not a plain name")
        self.push(Record(what, arguments))

    def fill(self, target: Any, pairs: list[Any]) -> None:
        entries = target.items if isinstance(target, Record) else target
        if not isinstance(entries, dict):
            raise PickleRefused("puts named entries into something that is no dictionary")
        for key, value in zip(pairs[::2], pairs[1::2], strict=True):
            # Other keys (of a library's own book-keeping) are of no use here, and hashing them has no bounds.
            if key is None or isinstance(key, str | bytes | int | float):
                entries[key] = value

    def extend(self, target: Any, values: list[Any]) -> None:
        if not isinstance(target, list):
            raise PickleRefused("appends to something that is no list")
        target.extend(values)

    def integer(self, n_bytes: int) -> int:
        if n_bytes > MAX_INTEGER_BYTES:
            raise PickleRefused(f"holds a whole number of {n_bytes} bytes")
        return int.from_bytes(self.take(n_bytes), "little", signed=True)


def _integer_line(machine: _Machine) -> Any:
    text = machine.line().removesuffix(b"L")
    if text in (b"00", b"01"):  # how protocol 0 writes False and True
        return text == b"01"
    if len(text) > 2 * MAX_INTEGER_BYTES:
        raise PickleRefused(f"holds a whole number of {len(text)} digits")
    return int(text)


def _quoted_line(machine: _Machine) -> str:
    text = machine.line().strip()
    if len(text) < 2 or text[:1] != text[-1:] or text[:1] not in b"'\"":
        raise PickleRefused(f"is damaged (byte {machine.at}: text without quotes)")
    return codecs.escape_decode(text[1:-1])[0].decode("latin-1")


def _build(machine: _Machine) -> None:
    state, target = machine.pop(), machine.stack[-1]
    if not isinstance(target, Record):
        raise PickleRefused("fills in something that is no object")
    target.state = state


def _put(machine: _Machine, key: int) -> None:
    if machine.stack[-1] is _MARK:
        raise PickleRefused("keeps a mark")
    machine.memo[key] = machine.stack[-1]


def _call(machine: _Machine) -> None:
    arguments, what = machine.pop(), machine.pop()
    machine.call(what, arguments)


def _call_by_keywords(machine: _Machine) -> None:
    keywords, arguments, what = machine.pop(), machine.pop(), machine.pop()
    if keywords:
        raise PickleRefused("makes an object by named arguments")
    machine.call(what, arguments)


def _inst(machine: _Machine) -> None:
    name = machine.named(machine.line().decode("latin-1"), machine.line().decode("latin-1"))
    machine.call(name, tuple(machine.since_mark()))


def _obj(machine: _Machine) -> None:
    what, *arguments = machine.since_mark()
    machine.call(what, tuple(arguments))


def _stack_global(machine: _Machine) -> None:
    name, module = machine.pop(), machine.pop()
    machine.push(machine.named(module, name))


def _dictionary(machine: _Machine) -> None:
    pairs = machine.since_mark()
    machine.push({})
    machine.fill(machine.stack[-1], pairs)


def _set_item(machine: _Machine) -> None:
    value, key = machine.pop(), machine.pop()
    machine.fill(machine.stack[-1], [key, value])


def _set_items(machine: _Machine) -> None:
    pairs = machine.since_mark()
    machine.fill(machine.stack[-1], pairs)


def _append(machine: _Machine) -> None:
    value = machine.pop()
    machine.extend(machine.stack[-1], [value])


def _appends(machine: _Machine) -> None:
    values = machine.since_mark()
    machine.extend(machine.stack[-1], values)


def _last(machine: _Machine, n: int) -> tuple[Any, ...]:
    values = [machine.pop() for _ in range(n)]
    return tuple(reversed(values))


def _proto(machine: _Machine) -> None:
    protocol = machine.take(1)[0]
    if protocol > 5:
        raise PickleRefused(f"is of protocol {protocol}; 0 to 5 are read")


def _text(machine: _Machine, n: int) -> str:
    return machine.take(n).decode("utf-8", "surrogatepass")


_STEPS: dict[int, Callable[[_Machine], Any]] = {
    ord("("): lambda m: m.push(_MARK),
    ord("0"): lambda m: m.stack.pop(),
    ord("1"): lambda m: m.since_mark(),
    ord("2"): lambda m: m.push(m.stack[-1]),
    ord("N"): lambda m: m.push(None),
    ord("I"): lambda m: m.push(_integer_line(m)),
    ord("L"): lambda m: m.push(_integer_line(m)),
    ord("F"): lambda m: m.push(float(m.line())),
    ord("J"): lambda m: m.push(m.number("<i")),
    ord("K"): lambda m: m.push(m.number("<B")),
    ord("M"): lambda m: m.push(m.number("<H")),
    ord("G"): lambda m: m.push(m.number(">d")),
    ord("S"): lambda m: m.push(_quoted_line(m)),
    ord("T"): lambda m: m.push(m.take(m.number("<i")).decode("latin-1")),
    ord("U"): lambda m: m.push(m.take(m.number("<B")).decode("latin-1")),
    ord("V"): lambda m: m.push(m.line().decode("raw-unicode-escape")),
    ord("X"): lambda m: m.push(_text(m, m.number("<I"))),
    ord("B"): lambda m: m.push(m.take(m.number("<I"))),
    ord("C"): lambda m: m.push(m.take(m.number("<B"))),
    ord("a"): _append,
    ord("e"): _appends,
    ord("]"): lambda m: m.push([]),
    ord("l"): lambda m: m.push(m.since_mark()),
    ord("}"): lambda m: m.push({}),
    ord("d"): _dictionary,
    ord("s"): _set_item,
    ord("u"): _set_items,
    ord(")"): lambda m: m.push(()),
    ord("t"): lambda m: m.push(tuple(m.since_mark())),
    ord("c"): lambda m: m.push(m.named(m.line().decode("latin-1"), m.line().decode("latin-1"))),
    ord("R"): _call,
    ord("b"): _build,
    ord("i"): _inst,
    ord("o"): _obj,
    ord("g"): lambda m: m.push(m.memo[int(m.line())]),
    ord("h"): lambda m: m.push(m.memo[m.number("<B")]),
    ord("j"): lambda m: m.push(m.memo[m.number("<I")]),
    ord("p"): lambda m: _put(m, int(m.line())),
    ord("q"): lambda m: _put(m, m.number("<B")),
    ord("r"): lambda m: _put(m, m.number("<I")),
    0x80: _proto,
    0x81: _call,
    0x85: lambda m: m.push(_last(m, 1)),
    0x86: lambda m: m.push(_last(m, 2)),
    0x87: lambda m: m.push(_last(m, 3)),
    0x88: lambda m: m.push(True),
    0x89: lambda m: m.push(False),
    0x8A: lambda m: m.push(m.integer(m.number("<B"))),
    0x8B: lambda m: m.push(m.integer(m.number("<i"))),
    0x8C: lambda m: m.push(_text(m, m.number("<B"))),
    0x8D: lambda m: m.push(_text(m, m.number("<Q"))),
    0x8E: lambda m: m.push(m.take(m.number("<Q"))),
    0x8F: lambda m: m.push([]),
    0x90: _appends,
    0x91: lambda m: m.push(m.since_mark()),
    0x92: _call_by_keywords,
    0x93: _stack_global,
    0x94: lambda m: _put(m, len(m.memo)),
    0x95: lambda m: m.take(8),
    0x96: lambda m: m.push(m.take(m.number("<Q"))),
    0x98: lambda m: None,
}
_REFUSED = {
    ord("P"): "an object kept elsewhere (persistent id)",
    ord("Q"): "an object kept elsewhere (persistent id)",
    0x82: "a registered extension code",
    0x83: "a registered extension code",
    0x84: "a registered extension code",
    0x97: "a buffer kept elsewhere",
}
