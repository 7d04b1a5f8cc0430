"""Tests that enforce the architecture: layers, cost of imports, forbidden constructs."""

import ast
import graphlib
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from tests.loading import loaded_by

ROOT = Path(__file__).parents[1]
STAGES = {
    "completion",
    "depth_fusion",
    "description",
    "detection",
    "learning",
    "reuse",
    "surface",
    "tracking",
}
BASE = {"arrays", "errors", "jit", "system", "types"}
LAYER = {
    **dict.fromkeys(BASE | {"py"}, 0),
    **dict.fromkeys(("cameras", "config", "executors", "geometry", "trees"), 1),
    **dict.fromkeys(
        (
            *STAGES,
            "colour",
            "recordings",
            "simulation",
            "schemas",
        ),
        2,
    ),
    **dict.fromkeys(("runs", "perception", "rehearsal"), 3),
    **dict.fromkeys(("outputs", "evaluation", "models"), 4),
    "pipeline": 5,
    "batch": 6,
    "api": 7,
    "__init__": 7,  # loads the Python interface when it is used
    "cli": 7,
    "__main__": 7,
}
FILES = sorted([*ROOT.glob("shapecat/**/*.py"), *ROOT.glob("cli/*.py")])


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """Return all nodes of the code of a file, its module first."""
    return tuple(ast.walk(ast.parse(path.read_text("utf-8"))))


def subpackage_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return "cli" if parts[0] == "cli" else parts[1]


def imported_subpackages(path: Path) -> set[str]:
    found = set()
    for node in nodes(path):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names = [node.module or ""]
            if node.module == "shapecat":
                names = [f"shapecat.{alias.name}" for alias in node.names]
        else:
            continue
        found |= {name.split(".")[1] for name in names if name.startswith("shapecat.")}
    return {name for name in found if not name.startswith("__")}


def wrong_import(here: str, other: str) -> str:
    """Return the problem with an import from one subpackage into another, or an empty string."""
    if other not in LAYER:
        return "has no layer: add it to the table above"
    if LAYER[other] > LAYER[here]:
        return "is above it"
    return "is a stage, too" if {here, other} <= STAGES else ""


def test_no_import_goes_up_or_across_stages() -> None:
    wrong = [
        f"{path.relative_to(ROOT)} imports {other}, which {reason}"
        for path in FILES
        for other in imported_subpackages(path) - {subpackage_of(path)}
        if (reason := wrong_import(subpackage_of(path), other))
    ]
    assert wrong == []


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    whole = parts if parts[0] == "shapecat" else ("shapecat", *parts)
    return ".".join(whole[:-1] if whole[-1] == "__init__" else whole)


def imported_modules(path: Path, modules: set[str]) -> set[str]:
    """Return the modules that a file imports, also inside its functions."""
    found = set()
    for node in nodes(path):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            whole = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= whole & modules or {node.module}
    return found & modules - {module_of(path)}


def test_imports_have_no_cycles() -> None:
    """Two files that import each other cannot be read, tested or moved alone."""
    modules = {module_of(path): path for path in FILES}
    graph = {name: imported_modules(path, set(modules)) for name, path in modules.items()}
    graph["shapecat"] = set()  # the Python interface, which loads its names when they are used

    graphlib.TopologicalSorter(graph).prepare()  # CycleError lists the cycle


def is_forbidden(node: ast.AST) -> bool:
    """Return whether a node prints, evaluates text, or catches everything."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return node.func.id in {"print", "eval", "exec"}
    return isinstance(node, ast.ExceptHandler) and node.type is None


def test_no_print_eval_or_bare_except() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}"
        for path in FILES
        for node in nodes(path)
        if is_forbidden(node)
    ]
    assert wrong == []


def test_only_documented_parts_of_numba_are_used() -> None:
    """Undocumented parts of numba's compiler change with any release."""
    documented = {"numba", "numba.extending"}
    for path in FILES:
        for node in nodes(path):
            if isinstance(node, ast.Import):
                used = {alias.name for alias in node.names}
            else:
                used = {node.module or ""} if isinstance(node, ast.ImportFrom) else set()
            assert {name for name in used if name.split(".")[0] == "numba"} <= documented, path
        assert "get_call_template" not in path.read_text("utf-8"), path


def test_help_loads_no_heavy_library() -> None:
    """People avoid commands that take a second to show their help or to report a typo.

    Every command checks its paths with ``is_url``, which must not load the whole of `batch`.
    """
    heavy = {"numba", "rerun", "open3d", "sklearn", "scipy", "pyarrow", "numpy", "rich"}

    assert loaded_by("import shapecat.cli.main, shapecat.batch.storage", heavy) == set()


def test_processing_loads_no_library_too_early() -> None:
    """Before the first frame, processing must load neither slow libraries nor display libraries.

    scipy.ndimage, pandas and Protocol Buffers take longer to load than all of shapecat. Open3D
    needs libEGL and libX11, which a server or a container does not have.
    """
    late = {"scipy.ndimage", "scipy.optimize", "pandas", "pyarrow.compute"}
    late |= {"google.protobuf", "PIL", "rerun"}
    never = {"open3d", "matplotlib", "sklearn"}
    code = (
        "import sys, shapecat.batch.runs, shapecat.recordings.decoding.decoders;"
        f"print(*{late} & set(sys.modules)); shapecat.open_run;"
        f"print(*{never | {'rerun', 'pandas'}} & set(sys.modules));"
        "import shapecat.outputs.annotation.annotated_mcap, shapecat.outputs.review.writing"
    )

    assert loaded_by(code, never) == set()


def test_commands_do_not_load_optional_imports_of_libraries(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Arrow would load pandas for its first array (0.5 s), and numba would load SciPy (0.1 s)."""
    monkeypatch.delenv("COVERAGE_PROCESS_CONFIG", raising=False)  # `make coverage` sets it
    code = (
        "import types, pyarrow, numpy as np, shapecat.__main__ as entry;"
        "use = lambda **_: (pyarrow.array([1]), __import__('shapecat.geometry').geometry"
        "    .level_box(np.ones((1, 3), np.float32), np.eye(3)));"
        "entry.import_module = lambda _: types.SimpleNamespace(main=use); entry.run()"
    )

    assert loaded_by(code, {"pandas", "scipy.linalg", "coverage"}) == set()


def test_kernels_do_without_linear_algebra_of_numpy() -> None:
    """Commands keep numba from loading SciPy, without which such a kernel does not compile."""
    for path in (path for path in FILES if "@kernel" in path.read_text("utf-8")):
        for function in nodes(path):
            decorators = getattr(function, "decorator_list", [])
            if any("kernel" in ast.unparse(one) for one in decorators):
                for node in ast.walk(function):
                    assert not isinstance(node, ast.MatMult), (path, function)
                    name = getattr(node, "attr", "")
                    assert name not in {"linalg", "dot", "vdot", "outer", "kron"}, (path, name)


def test_root_of_package_has_few_files() -> None:
    """A file that only one subpackage uses must not be in the root, which hides its owner."""
    assert len(list((ROOT / "shapecat").glob("*.py"))) <= 12


def test_architecture_page_is_short() -> None:
    assert (ROOT / "ARCHITECTURE.md").read_text("utf-8").count("\n") <= 150


def test_architecture_picture_is_up_to_date() -> None:
    """`make picture` redraws the picture after a change of imports."""
    from tests.picture import PICTURE, draw  # noqa: PLC0415  it imports this file

    assert PICTURE.read_text("utf-8") == draw()


def test_loaded_libraries_are_detected() -> None:
    assert loaded_by("import json.decoder", {"json", "numpy"}) == {"json"}


def test_inlined_kernel_has_one_caller_with_same_arithmetic() -> None:
    """A second caller would compile the kernel again; other fast-math flags give other numbers."""
    flags, calls = kernels()
    inlined = {name: own for name, own in flags.items() if own.get("inline")}
    assert inlined
    for name, own in inlined.items():
        assert calls[name] == [(True, own.get("fast", False))], name


def test_inner_kernel_is_called_only_by_kernels() -> None:
    """Called from Python, it would silently run uncompiled, a hundred times slower."""
    flags, calls = kernels()
    inner = [name for name, own in flags.items() if own.get("inner")]
    assert inner
    for name in inner:
        assert calls[name], name
        assert all(by_kernel for by_kernel, _ in calls[name]), name


@cache
def kernels() -> tuple[
    dict[tuple[str, str], dict[str, bool]], dict[tuple[str, str], list[tuple[bool, bool]]]
]:
    """Return the arguments of each ``@kernel``, and the uses of each function elsewhere.

    Functions are named by their module and name. A use says whether it is in a kernel, and whether
    that is ``fast``.
    """
    calls: dict[tuple[str, str], list[tuple[bool, bool]]] = {}
    flags: dict[tuple[str, str], dict[str, bool]] = {}
    for path in FILES:
        tree: Any = nodes(path)[0]
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        origins = {
            alias.name: str(node.module)
            for node in tree.body
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
        for statement in tree.body:
            name = getattr(statement, "name", "")
            own = _kernel_flags(statement)
            if own is not None:
                flags[module, name] = own
            for node in ast.walk(statement):
                if isinstance(node, ast.Name) and node.id != name:
                    used = origins.get(node.id, module), node.id
                elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                    used = f"{origins.get(node.value.id)}.{node.value.id}", node.attr
                else:
                    continue
                fast = own is not None and own.get("fast", False)
                calls.setdefault(used, []).append((own is not None, fast))
    return flags, calls


def _kernel_flags(statement: ast.stmt) -> dict[str, bool] | None:
    """Return the arguments of ``@kernel``; None without it."""
    for decorator in statement.decorator_list if isinstance(statement, ast.FunctionDef) else ():
        arguments = decorator.keywords if isinstance(decorator, ast.Call) else []
        name = decorator.func if isinstance(decorator, ast.Call) else decorator
        if isinstance(name, ast.Name) and name.id == "kernel":
            return {
                str(argument.arg): bool(ast.literal_eval(argument.value)) for argument in arguments
            }
    return None
