"""The rooms' order: who may import whom, what may load when a module is imported, what the wheel holds."""

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
MAY_IMPORT = {
    "capture": set(),
    "hull": {"capture"},
    "fit": {"capture", "hull"},
    "render": {"capture", "hull", "fit"},
    "bodyhull": {"capture", "hull", "fit", "render"},
}
#: Libraries that a room may use, besides the standard library; others must earn a line here.
COMMON = {"numpy", "scipy", "jaxtyping", "tqdm"}
LIBRARIES = {
    "capture": {"cv2", "pycolmap"},
    "hull": {"cv2", "skimage", "open3d", "numba"},
    "fit": {"jax", "numba", "skimage", "open3d", "threadpoolctl", "platformdirs", "body_models"},
    "render": {"cv2", "open3d", "pyrender", "OpenGL", "av", "jinja2", "matplotlib"},
    "bodyhull": {"tyro", "jax", "av"},
}
#: Only imported inside functions: they start something, or take seconds.
LAZY = {"pyrender", "OpenGL", "open3d", "av", "body_models", "matplotlib"}
MODULES = sorted(path for room in MAY_IMPORT for path in (ROOT / room).rglob("*.py"))


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def _runs_at_import(node: ast.AST) -> bool:
    if isinstance(node, ast.If):
        return "TYPE_CHECKING" not in ast.unparse(node.test)
    return not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)


def imports(path: Path, at_module_level: bool = False) -> Iterator[tuple[int, str]]:
    """(line, absolute dotted name) of what is imported; at module level `if TYPE_CHECKING:` never runs."""
    package = path.relative_to(ROOT).parent.parts

    def walk(node: ast.AST) -> Iterator[tuple[int, str]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                yield from ((child.lineno, alias.name) for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                base = list(package[: len(package) - child.level + 1]) if child.level else []
                module = ".".join([*base, *([child.module] if child.module else [])])
                yield child.lineno, module
                yield from ((child.lineno, f"{module}.{alias.name}") for alias in child.names)
            elif at_module_level and not _runs_at_import(child):
                continue
            else:
                yield from walk(child)

    yield from walk(ast.parse(path.read_text(), name_of(path)))


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_no_room_imports_what_lies_behind_it(path: Path) -> None:
    room = path.relative_to(ROOT).parts[0]
    allowed = MAY_IMPORT[room] | {room}
    wrong = [
        f"line {line}: {name}"
        for line, name in imports(path)
        if name.split(".")[0] in set(MAY_IMPORT) - allowed
    ]
    assert not wrong, f"{room}/ may import {sorted(allowed)}: {wrong}"


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_only_known_libraries_are_used(path: Path) -> None:
    room = path.relative_to(ROOT).parts[0]
    known = COMMON | LIBRARIES[room] | set(MAY_IMPORT) | set(sys.stdlib_module_names)
    wrong = [f"line {line}: {name}" for line, name in imports(path) if name.split(".")[0] not in known]
    assert not wrong, wrong


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_what_starts_something_is_imported_inside_functions(path: Path) -> None:
    wrong = [
        f"line {line}: {name}"
        for line, name in imports(path, at_module_level=True)
        if name.split(".")[0] in LAZY
    ]
    assert not wrong, wrong


def test_the_reader_of_imports_sees_what_it_should(tmp_path: Path) -> None:
    """The laws above would hold for a reader that finds nothing."""
    found = {name for _, name in imports(ROOT / "render" / "gl.py")}
    assert {"pyrender", "OpenGL.GL"} <= found
    assert "pyrender" not in {name for _, name in imports(ROOT / "render" / "gl.py", at_module_level=True)}
    assert "render.overlay" in {name for _, name in imports(ROOT / "render" / "report.py")}, (
        "relative ones too"
    )
    assert any(name == "fit.settings" for _, name in imports(ROOT / "bodyhull" / "cli.py"))


@pytest.mark.parametrize(
    ("room", "unwanted"),
    [
        ("capture", "jax jaxlib pyrender OpenGL open3d fit render bodyhull"),
        ("hull", "jax jaxlib pyrender OpenGL open3d fit render bodyhull"),
        ("fit", "pyrender OpenGL open3d render bodyhull"),
        ("render", "pyrender OpenGL open3d av bodyhull"),
        ("bodyhull.cli", "jax jaxlib pyrender OpenGL open3d av cv2 pycolmap skimage"),
    ],
)
def test_importing_a_room_loads_nothing_heavy(room: str, unwanted: str) -> None:
    """In a process of its own: import every module of the room, then look at what has been loaded."""
    folder, _, single = room.partition(".")
    names = [room] if single else [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in MODULES
        if path.relative_to(ROOT).parts[0] == folder and not path.name.startswith("__")
    ]  # fmt: skip
    code = (
        f"import importlib, sys\nfor name in {names!r}: importlib.import_module(name)\n"
        f"print(*sorted(set({unwanted.split()!r}) & set(sys.modules)))"
    )
    child = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert child.returncode == 0, child.stderr
    assert child.stdout.split() == [], f"importing {room} loads {child.stdout}"


def test_the_command_starts_no_jax_backend_and_no_driver_when_imported() -> None:
    code = (
        "import fit.solver, fit.body.skinning, jax\n"
        "from jax._src import xla_bridge\nprint(len(xla_bridge._backends))"
    )
    child = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert child.stdout.strip() == "0", f"a JAX backend starts at import: {child.stdout}{child.stderr}"


def test_every_package_is_listed_and_typed_and_tests_are_not_shipped() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    listed = project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert set(listed) == set(MAY_IMPORT)
    folders = {path.parent.name for path in ROOT.glob("*/__init__.py")} - {"tests", "benchmarks"}
    assert folders == set(MAY_IMPORT), "a package lies at the top that is not listed, or the other way round"
    for room in MAY_IMPORT:
        assert (ROOT / room / "py.typed").is_file(), f"{room}/py.typed is missing"
        for folder in {path.parent for path in (ROOT / room).rglob("*.py")}:
            assert (folder / "__init__.py").is_file(), f"{folder} is no package"
    assert project["tool"]["pytest"]["ini_options"]["pythonpath"] == ["."]
    assert (
        project["tool"]["hatch"]["version"]["path"] == "bodyhull/__init__.py"
        and "version" not in project["project"]
    )


def test_every_dependency_is_used_and_every_library_is_a_dependency() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = {text.split(">")[0].split("=")[0].strip() for text in project["dependencies"]}
    modules = {
        "opencv-contrib-python-headless": "cv2", "scikit-image": "skimage", "pyrender": "pyrender",
    }  # fmt: skip
    as_modules = {modules.get(name, name) for name in named}
    used = {name.split(".")[0] for path in MODULES for _, name in imports(path)}
    extra = project["optional-dependencies"]["bodies"]
    assert [text.split("[")[0] for text in extra] == ["body-models"], "the one library that is optional"
    assert not any("body_models" in n for p in MODULES for _, n in imports(p, at_module_level=True))
    used -= {"body_models"}
    third_party = used - set(sys.stdlib_module_names) - set(MAY_IMPORT)
    assert third_party - as_modules <= {"OpenGL"}, "used, but no dependency (PyOpenGL comes with pyrender)"
    assert as_modules - third_party == set(), "a dependency that nothing uses"


def test_modules_stay_readable() -> None:
    """Past 500 lines a second idea has moved in."""
    long = {name_of(path): n for path in MODULES if (n := len(path.read_text().splitlines())) > 500}
    assert not long, long
