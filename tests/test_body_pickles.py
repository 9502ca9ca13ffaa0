"""A body file is never a program: hostile and damaged pickles are refused and named, and nothing runs."""

import io
import pickle
import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fit.body import BodyModelError, load_body
from fit.body.pickle_arrays import array_of, permit, read_mapping, text_of
from fit.body.pickle_reader import Name, PickleRefused, read_pickle

CANARY = "canary-was-here"


@pytest.fixture
def canary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A file that every hostile pickle here tries to make, in the current folder."""
    monkeypatch.chdir(tmp_path)
    yield tmp_path / CANARY
    assert not (tmp_path / CANARY).exists(), "a pickle was run"


def text(value: str) -> bytes:
    data = value.encode()
    return b"X" + struct.pack("<I", len(data)) + data


def call(module: str, name: str, *arguments: bytes) -> bytes:
    """GLOBAL, arguments, REDUCE."""
    return f"c{module}\n{name}\n(".encode() + b"".join(arguments) + b"tR"


def program(body: bytes, protocol: int = 2) -> bytes:
    return b"\x80" + bytes([protocol]) + body + b"."


TOUCH = f"touch {CANARY}"
PYTHON = f"open({CANARY!r}, 'w')"
HOSTILE = {
    "os.system": call("os", "system", text(TOUCH)),
    "posix.system": call("posix", "system", text(TOUCH)),
    "nt.system": call("nt", "system", text(TOUCH)),
    "subprocess.Popen": call("subprocess", "Popen", text(TOUCH)),
    "builtins.eval": call("builtins", "eval", text(PYTHON)),
    "__builtin__.eval": call("__builtin__", "eval", text(PYTHON)),
    "builtins.exec": call("builtins", "exec", text(PYTHON)),
    "builtins.open": call("builtins", "open", text(CANARY), text("w")),
    "builtins.getattr": call("builtins", "getattr", b"cos\nsystem\n", text("x")),
    "builtins.__import__": call("builtins", "__import__", text("os")),
    "operator.attrgetter": call("operator", "attrgetter", text("system")),
    "operator.methodcaller": call("operator", "methodcaller", text("touch"), text(CANARY)),
    "functools.partial": call("functools", "partial", b"cos\nsystem\n"),
    "importlib.import_module": call("importlib", "import_module", text("os")),
    "pickle.loads": call("pickle", "loads", text("")),
    "_pickle.loads": call("_pickle", "loads", text("")),
    "copyreg.add_extension": call("copyreg", "add_extension", text("os"), text("system")),
    "types.CodeType": call("types", "CodeType"),
    "numpy.load": call("numpy", "load", text(CANARY)),
    "numpy.save": call("numpy", "save", text(CANARY), b"K\x01"),
    "numpy.testing._private.utils.runstring": call(
        "numpy.testing._private.utils", "runstring", text(PYTHON), b"}"
    ),
    "numpy.f2py.compile": call("numpy.f2py", "compile", text(PYTHON)),
    "numpy.core.multiarray.fromfile": call("numpy.core.multiarray", "fromfile", text(CANARY)),
    "numpy.ctypeslib.load_library": call("numpy.ctypeslib", "load_library", text("libc"), text("/")),
    "scipy.io.loadmat": call("scipy.io", "loadmat", text(CANARY)),
    "scipy.sparse.csc.np": call("scipy.sparse.csc", "np"),
    "torch._utils._rebuild_tensor_v2": call("torch._utils", "_rebuild_tensor_v2"),
    "chumpyx.system": call("chumpyx", "system", text(TOUCH)),
}


def in_npz(path: Path, data: bytes, key: str = "v_template") -> None:
    """An .npz one of whose arrays holds objects: such a member is a header and a pickle."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|O", "fortran_order": False, "shape": ()})

    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{key}.npy", header.getvalue() + data)
        for other in ("f", "shapedirs", "posedirs", "weights", "J_regressor", "kintree_table"):
            plain = io.BytesIO()
            np.save(plain, np.zeros((2, 2)))
            archive.writestr(f"{other}.npy", plain.getvalue())


@pytest.mark.parametrize("name", HOSTILE)
def test_a_pickle_that_names_anything_else_is_refused(name: str, tmp_path: Path, canary: Path) -> None:
    (tmp_path / "trap.pkl").write_bytes(program(HOSTILE[name]))
    with pytest.raises(BodyModelError, match=r"names .*, which no body file needs.* not run") as told:
        load_body(tmp_path / "trap.pkl")
    assert "trap.pkl" in str(told.value) and len(str(told.value).splitlines()) == 1
    in_npz(tmp_path / "trap.npz", program(HOSTILE[name]))
    with pytest.raises(BodyModelError, match=r"trap\.npz: v_template names .*, which no body file needs"):
        load_body(tmp_path / "trap.npz")


@pytest.mark.parametrize("name", ["os.system", "builtins.eval", "numpy.load"])
def test_however_deep_it_is_hidden(name: str, tmp_path: Path, canary: Path) -> None:
    hidden = {
        "a value": b"}" + text("v_template") + HOSTILE[name] + b"s",
        "a key": b"}" + HOSTILE[name] + b"K\x01s",
        "a list": b"](" + HOSTILE[name] * 3 + b"e",
        "arguments of a good call": call("collections", "OrderedDict", HOSTILE[name]),
        "the state of a chumpy object": b"cchumpy.ch\nCh\n)\x81}" + text("x") + HOSTILE[name] + b"sb",
        "the state of an array": b"cnumpy\nndarray\n)\x81" + HOSTILE[name] + b"b",
        "an object of protocol 0": b"(i" + name.replace(".", "\n").encode() + b"\n",
        "an object of old classes": b"(c" + name.replace(".", "\n").encode() + b"\n" + text(TOUCH) + b"o",
        "something thrown away": HOSTILE[name] + b"0}",
        "a memo": HOSTILE[name] + b"q\x000}" + text("v_template") + b"h\x00s",
        "a name of protocol 4": b"".join(map(text, name.split("."))) + b"\x93" + text("x") + b"\x85R",
    }
    for where, body in hidden.items():
        (tmp_path / "trap.pkl").write_bytes(program(body, 4))
        with pytest.raises(BodyModelError, match="which no body file needs"):
            load_body(tmp_path / "trap.pkl")
        assert not canary.exists(), where


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("numpy", "ndarray.tofile"),
        ("numpy", "core.multiarray._reconstruct"),
        ("collections", "OrderedDict.fromkeys"),
        ("builtins", "dict.__class__"),
        ("builtins", "object.__subclasses__"),
        ("numpy.ndarray", "tofile"),
        ("copyreg", "_reconstructor.__globals__"),
        ("chumpy\nos", "system"),
        ("", ""),
        ("numpy", "\u0430rray"),
    ],
)
def test_dotted_and_odd_names_of_protocol_4(module: str, name: str, tmp_path: Path, canary: Path) -> None:
    (tmp_path / "trap.pkl").write_bytes(program(text(module) + text(name) + b"\x93)R", 4))
    with pytest.raises(BodyModelError) as told:
        load_body(tmp_path / "trap.pkl")
    assert "names" in str(told.value) and len(str(told.value).splitlines()) == 1


def test_permitted_names_are_never_looked_up(tmp_path: Path, canary: Path) -> None:
    """Even what is allowed is not imported or called: chumpy's modules might have been replaced."""
    (tmp_path / "chumpy.py").write_text(PYTHON)
    body = (
        b"}"
        + text("v_template")
        + b"cchumpy\nCh\n)\x81}"
        + text("x")
        + b"G"
        + struct.pack(">d", 2.5)
        + b"sbs"
    )
    assert array_of(read_mapping(program(body))["v_template"]) == 2.5
    made = read_pickle(program(call("chumpy.ch", "Ch", text(TOUCH))), permit)
    assert made.name == Name("chumpy.ch", "Ch")
    for name in ("bytes", "bytearray", "set", "list", "complex"):
        assert read_pickle(program(call("builtins", name, b"K\x03")), permit).arguments == (3,)


def test_tricks_with_state(tmp_path: Path, canary: Path) -> None:
    tricks = {
        b"}(" + text("__class__") + b"cnumpy\nndarray\n" + text("__setstate__") + b"cnumpy\ndtype\nu": b"",
        b"cnumpy\nndarray\n}b": b"fills in something that is no object",
        b"K\x01}b": b"fills in something that is no object",
        b"}}b": b"fills in something that is no object",
        b"}K\x01K\x02s)R": b"calls something that is not a plain name",
        b"(K\x01K\x02t)R": b"calls something that is not a plain name",
        call("chumpy.ch", "Ch") + b")R": b"calls something that is not a plain name",
        b"\x82\x01": b"a registered extension code",
        b"\x83\x01\x00": b"a registered extension code",
        b"\x84\x01\x00\x00\x00": b"a registered extension code",
        b"Pposix\n": b"an object kept elsewhere",
        text("x") + b"Q": b"an object kept elsewhere",
        b"\x97": b"a buffer kept elsewhere",
        b"cnumpy\nndarray\n)}" + text("a") + b"K\x01s\x92": b"by named arguments",
    }
    for body, message in tricks.items():
        (tmp_path / "trap.pkl").write_bytes(program(body))
        with pytest.raises(BodyModelError, match=message.decode() or "no v_template"):
            load_body(tmp_path / "trap.pkl")


def numbers(shape: tuple[int, ...], code: str, data: bytes) -> bytes:
    """numpy's array, as numpy itself writes it, with a claimed shape."""
    dims = b"(" + b"".join(b"\x8a\x08" + struct.pack("<q", n) for n in shape) + b"t"
    dtype = (
        call("numpy", "dtype", text(code), b"K\x00", b"K\x01")
        + b"(K\x03"
        + text("<")
        + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    )
    made = call("numpy.core.multiarray", "_reconstruct", b"cnumpy\nndarray\n", b"K\x00\x85", b"C\x01b")
    return made + b"(K\x01" + dims + dtype + b"\x89B" + struct.pack("<I", len(data)) + data + b"tb"


def test_sizes_are_checked_before_memory_is_asked_for(tmp_path: Path) -> None:
    good = read_pickle(program(numbers((2,), "f8", bytes(16))), permit)
    np.testing.assert_array_equal(array_of(good), np.zeros(2))
    claims = {
        "claims an array of 1000000000 x 1000 elements": numbers((10**9, 1000), "f8", b""),
        r"in 16 bytes": numbers((10**7,), "f8", bytes(16)),
        "claims an array of -1": numbers((-1,), "f8", b""),
        "of a type other than numbers": numbers((1,), "f8,O", bytes(16)),
        "objects without its objects": numbers((2,), "O8", bytes(16)),
        "an unknown type": numbers((1,), "f3", bytes(3)),
    }
    for message, body in claims.items():
        (tmp_path / "big.pkl").write_bytes(program(b"}" + text("v_template") + body + b"s"))
        with pytest.raises(PickleRefused, match=message):
            array_of(read_mapping((tmp_path / "big.pkl").read_bytes())["v_template"])
    for body in (
        call("builtins", "bytearray", b"\x8a\x06" + (10**12).to_bytes(6, "little")),
        b"\x8b\xff\xff\xff\x7f",
    ):
        with pytest.raises(PickleRefused):
            array_of(read_pickle(program(body), permit))


def test_small_files_that_would_unfold_to_large_ones() -> None:
    """A list of a thousand times the same list, twelve levels deep; and views of views of views."""
    laughs = b"](" + b"K\x01" * 1000 + b"eq\x00"
    for level in range(12):
        laughs += b"](" + b"h" + bytes([level]) + (b"h" + bytes([level])) * 999 + b"eq" + bytes([level + 1])
    with pytest.raises(PickleRefused, match="claims arrays of more than"):
        array_of(read_pickle(program(laughs), permit))
    empty = b"]q\x00"
    for level in range(12):
        empty += b"](" + (b"h" + bytes([level])) * 1000 + b"eq" + bytes([level + 1])
    with pytest.raises(PickleRefused):
        array_of(read_pickle(program(empty), permit))
    wide = b"T" + struct.pack("<i", 10**6) + b"x" * 10**6 + b"q\x00](" + b"h\x00" * 10**4 + b"e"
    with pytest.raises(PickleRefused, match="claims arrays of more than"):
        array_of(read_pickle(program(wide), permit))
    nested = b"](" * 5_000 + b"K\x01" + b"e" * 5_000
    with pytest.raises(PickleRefused, match="deep"):
        array_of(read_pickle(program(nested), permit))
    itself = b"]q\x00h\x00a"
    with pytest.raises(PickleRefused, match="deep"):
        array_of(read_pickle(program(itself), permit))
    chain = b"N" + b"".join(b"q\x00cchumpy.ch\nCh\n)\x81}" + text("x") + b"h\x00sb" for _ in range(1000))
    with pytest.raises(PickleRefused, match="deep"):
        array_of(read_pickle(program(chain), permit))
    deep_key = b"}" + b")" + b"\x85" * 50_000 + b"K\x01s"
    assert read_pickle(program(deep_key), permit) == {}


def test_a_long_program_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    from fit.body import pickle_reader

    assert pickle_reader.MAX_STEPS < 10_000_000  # some seconds
    monkeypatch.setattr(pickle_reader, "MAX_STEPS", 1000)
    assert read_pickle(program(b"N0" * 400 + b"N"), permit) is None
    with pytest.raises(PickleRefused, match="more than 1000 steps"):
        read_pickle(program(b"N0" * 600), permit)


def test_an_archive_that_unpacks_to_more_than_a_body(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from fit.body import body_archive

    monkeypatch.setattr(body_archive, "MAX_BYTES", 10_000)
    np.savez_compressed(tmp_path / "bomb.npz", **{k: np.zeros(10**5) for k in (
        "v_template", "f", "shapedirs", "posedirs", "weights", "J_regressor", "kintree_table")})  # fmt: skip
    with pytest.raises(BodyModelError, match=r"v_template unpacks to 800128 bytes; at most 10000 are read"):
        load_body(tmp_path / "bomb.npz")


@pytest.mark.parametrize("shape", ["(1000000000000,)", "(3, 1000000)", "(-5,)"])
def test_an_array_that_is_announced_larger_than_it_is(tmp_path: Path, shape: str) -> None:
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
    member = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(16)
    with zipfile.ZipFile(tmp_path / "big.npz", "w") as archive:
        for key in ("v_template", "f", "shapedirs", "posedirs", "weights", "J_regressor", "kintree_table"):
            archive.writestr(f"{key}.npy", member)
    with pytest.raises(
        BodyModelError, match=r"v_template is announced with shape \(.*, but 16 bytes are there"
    ):
        load_body(tmp_path / "big.npz")


def test_sparse_matrices_and_views_that_reach_outside() -> None:
    def sparse(kind: str, **state: object) -> object:
        data = b"cscipy.sparse." + f"{kind}\n{kind}_matrix\n".encode() + b")\x81"
        return read_pickle(program(data + pickle.dumps(state, 2)[2:-1] + b"b"), permit)

    ones = np.ones(2)
    wrong = [
        sparse("csc", _shape=(2, 2), data=ones, indices=np.array([0, 9]), indptr=np.array([0, 1, 2])),
        sparse("csc", _shape=(2, 2), data=ones, indices=np.array([0, -1]), indptr=np.array([0, 1, 2])),
        sparse("csr", _shape=(2, 2), data=ones, indices=np.array([0, 1]), indptr=np.array([0, 5, 2])),
        sparse("csr", _shape=(2, 2), data=ones, indices=np.array([0, 1]), indptr=np.array([0, 1, 200])),
        sparse("csr", _shape=(2, 2), data=ones, indices=np.array([0.5, 1]), indptr=np.array([0, 1, 2])),
        sparse("coo", _shape=(2, 2), data=ones, row=np.array([0, 7]), col=np.array([0, 1])),
        sparse("coo", _shape=(2, 2), data=ones),
        sparse("csc", _shape=(10**6, 10**6), data=ones, indices=np.array([0, 1]), indptr=np.array([0, 1, 2])),
        sparse("csc", data=ones),
        sparse("csc"),
    ]
    for matrix in wrong:
        with pytest.raises(PickleRefused):
            array_of(matrix)
    for index in ([0, 5], [-3, 0]):
        view = (
            b"cchumpy.reordering\nSelect\n)\x81"
            + pickle.dumps({"a": ones, "idxs": np.array(index)}, 2)[2:-1]
            + b"b"
        )
        with pytest.raises(PickleRefused, match="reaches outside its array"):
            array_of(read_pickle(program(view), permit))
    expression = b"cchumpy.ch_ops\nadd\n)\x81}" + text("b") + b"K\x01sb"
    with pytest.raises(PickleRefused, match=r"a chumpy expression chumpy\.ch_ops\.add instead of numbers"):
        array_of(read_pickle(program(expression), permit))


def test_cut_and_scrambled_pickles_say_so(tmp_path: Path) -> None:
    whole = pickle.dumps({"v_template": np.zeros((5, 3)), "f": [1, 2], "name": "a"}, 2)
    random = np.random.default_rng(0)
    for n in range(len(whole)):
        (tmp_path / "cut.pkl").write_bytes(whole[:n])
        with pytest.raises(BodyModelError, match=r"cut\.pkl: this pickle (ends early|is damaged|is not)"):
            load_body(tmp_path / "cut.pkl")
    for _ in range(1000):
        scrambled = bytearray(whole)
        for at in random.integers(2, len(whole), 3):
            scrambled[at] = random.integers(256)
        (tmp_path / "odd.pkl").write_bytes(scrambled)
        with pytest.raises(BodyModelError):  # what is still readable lacks the other keys
            load_body(tmp_path / "odd.pkl")
    for content in (b"", b"\n", b"PK", b"<html>", b"\x89PNG\r\n", b"\x80\x09.", b"N.", b"](K\x01e."):
        (tmp_path / "odd.pkl").write_bytes(content)
        with pytest.raises(BodyModelError, match=r"odd\.pkl: "):
            load_body(tmp_path / "odd.pkl")


def test_plain_content_reads_as_python_reads_it() -> None:
    content = {
        "text": "a \u00e4 \U0001f600",
        "bytes": b"\x00\xff",
        "numbers": [1, -1, 300, 70_000, -(2**40), 2**200, 1.5],
        "nothing": None,
        "truth": [True, False],
        "pair": (1, (2, (3,)), ()),
        "nested": {"a": {"b": []}},
    }
    for protocol in range(6):
        found = read_pickle(pickle.dumps(content, protocol), permit)
        if protocol < 3:  # bytes are text to be encoded there
            assert found.pop("bytes").name == (Name("_codecs", "encode"))
        assert found == {k: content[k] for k in found}
        assert text_of(read_pickle(pickle.dumps(np.array("m"), protocol), permit)) == "m"
