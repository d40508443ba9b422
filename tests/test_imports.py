"""Imports go down only and never in a circle; what a torch-free runtime needs does not import torch."""

import ast
import importlib
import subprocess
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib.util import find_spec
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "gsencoder"

LEVELS = (
    ("core",), ("types",), ("geometry",), ("text", "data", "render"), ("models", "teachers"),
    ("fusion", "reconstruct"), ("memory",), ("train", "infer"), ("evaluate",), ("app",), ("__main__",),
)  # fmt: skip
"""Lowest first. A part may import lower levels and itself; parts of one level do not know each other."""

RANK = {name: rank for rank, names in enumerate(LEVELS) for name in names}

TORCH_FREE = [
    "gsencoder", "gsencoder.types", "gsencoder.core.errors", "gsencoder.data.splats.files",
    "gsencoder.data.splats.repair", "gsencoder.text.table", "gsencoder.core.archive", "gsencoder.fusion.basis",
    "gsencoder.fusion.checkpoint", "gsencoder.fusion.folder", "gsencoder.memory.reduction",
    "gsencoder.models.grid", "gsencoder.infer.encode", "gsencoder.infer.onnx.runtime",
    "gsencoder.app.commands.encode", "gsencoder.app.commands.localize", "gsencoder.app.commands.view",
    "gsencoder.evaluate.benchmarks.answers", "gsencoder.evaluate.benchmarks.captions",
    "gsencoder.infer.localize", "gsencoder.infer.draw", "gsencoder.infer.page.report", "gsencoder.app.output",
    "gsencoder.app.options", "gsencoder.app.compose", "gsencoder.app.commands.inspect",
    "gsencoder.app.commands.repair", "gsencoder.app.main",
]  # fmt: skip


def part_of(path: Path, package: Path = PACKAGE) -> str:
    """The part of the package that a file belongs to: a folder's name, or a top file's."""
    relative = path.relative_to(package)
    return relative.parts[0] if len(relative.parts) > 1 else relative.stem


def public_names() -> dict[str, str]:
    """The parts that the package's lazy names come from, such as `load_splat` from data."""
    import gsencoder

    return {name: home.split(".")[1] for name, home in gsencoder._HOME.items()}


@cache
def imported_names(source: str, module: str) -> list[tuple[int, str]]:
    """Line and dotted name of every import of a file, wherever it stands, also by `import_module("…")`. `module` is its
    dotted name, for relative imports; that of a package ends in `.__init__`."""
    names: list[tuple[int, str]] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(module.split(".")[: -node.level]) if node.level else ""
            base = ".".join(filter(None, [base, node.module]))
            names += [(node.lineno, f"{base}.{alias.name}") for alias in node.names]
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            function = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if function in ("import_module", "__import__") and isinstance(node.args[0].value, str):
                names.append((node.lineno, node.args[0].value))
    return names


def imports_of(source: str, module: str, lazy: dict[str, str]) -> list[tuple[int, str]]:
    """Line and part of every import of the package in a file; `lazy` are the parts that public names come from."""
    pieces = [(line, name.split(".")) for line, name in imported_names(source, module)]
    return [(line, lazy.get(each[1], each[1])) for line, each in pieces if each[0] == "gsencoder" and len(each) > 1]


def upward(source: str, module: str, lazy: dict[str, str]) -> list[str]:
    """The imports of a file that do not go down."""
    own = module.split(".")[1]
    wrong = []
    for line, part in imports_of(source, module, lazy):
        if part == own or part not in RANK:  # `gsencoder.__version__` and the like belong to no part.
            continue
        if RANK[part] >= RANK[own]:
            wrong.append(f"{module} line {line}: {own} imports {part}")
    return wrong


def files() -> list[Path]:
    return sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def test_every_part_of_the_package_has_its_level() -> None:
    assert {part_of(path) for path in files()} == set(RANK)


def module_of(path: Path) -> str:
    """The dotted name of a file; that of a package ends in `.__init__`."""
    return ".".join(("gsencoder", *path.relative_to(PACKAGE).with_suffix("").parts))


def circle(imports: dict[str, list[str]], folder: str) -> list[str]:
    """Children of a folder, files or folders, that import each other around a circle; empty where there is none.

    Args:
        imports: imported dotted names by dotted name of the importing module.
        folder: its dotted name.
    """
    graph: dict[str, set[str]] = {}
    for module, names in imports.items():
        if module.startswith(f"{folder}."):
            child = module[len(folder) + 1 :].split(".")[0]
            children = {name[len(folder) + 1 :].split(".")[0] for name in names if name.startswith(f"{folder}.")}
            graph.setdefault(child, set()).update(children - {child})
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


@cache
def imports_by_module() -> dict[str, list[str]]:
    """The dotted names that each module of the package imports."""
    sources = {module_of(path): path.read_text(encoding="utf-8") for path in files()}
    return {module: [name for _, name in imported_names(text, module)] for module, text in sources.items()}


def test_the_children_of_a_folder_import_each_other_in_one_direction() -> None:
    folders = {".".join(("gsencoder", *path.parent.relative_to(PACKAGE).parts)) for path in files()}
    circles = {folder: circle(imports_by_module(), folder) for folder in sorted(folders)}
    assert {folder: children for folder, children in circles.items() if children} == {}


def test_a_circle_is_seen_between_files_and_between_folders() -> None:
    files_of_one = {"p.f.a": ["p.f.b.name"], "p.f.b": ["p.f.c"], "p.f.c": ["p.f.a.other"], "p.f.d": ["p.f.a"]}
    assert set(circle(files_of_one, "p.f")) == {"a", "b", "c"}
    assert circle(files_of_one, "p") == []
    folders = {"p.f.a": ["p.g.b"], "p.g.c": ["p.f.d"]}
    assert set(circle(folders, "p")) == {"f", "g"}
    assert circle(folders, "p.f") == []


def test_imports_go_down_only() -> None:
    lazy = public_names()
    assert [line for path in files() for line in upward(path.read_text("utf-8"), module_of(path), lazy)] == []


def test_the_package_itself_imports_nothing_at_load() -> None:
    assert imports_of((PACKAGE / "__init__.py").read_text(), "gsencoder.__init__", {}) == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("gsencoder.render.blend", "import gsencoder.data.splats.files"),
        ("gsencoder.data.splats.files", "from ...render import blend"),
        ("gsencoder.fusion.__init__", "from ..train.trainer import Trainer"),
        ("gsencoder.teachers.onnx", "def f():\n    from gsencoder.infer import text"),
        ("gsencoder.types", "from gsencoder import load_splat"),
        ("gsencoder.core.errors", "import gsencoder.types"),
        ("gsencoder.text.table", "if True:\n    import gsencoder.evaluate.report as report"),
        ("gsencoder.render.blend", "import importlib\nimportlib.import_module('gsencoder.data.splats.files')"),
    ],
)
def test_an_upward_import_is_found_wherever_it_hides(module: str, source: str) -> None:
    assert len(upward(source, module, {"load_splat": "data"})) == 1


def test_torch_free_modules_import_neither_torch_nor_codecs() -> None:
    # One after the other in one process: the first that brings one along is the one that is named.
    code = (
        "import importlib, sys\n"
        "for module in sys.argv[1:]:\n"
        "    importlib.import_module(module)\n"
        "    if heavy := {'torch', 'imagecodecs'} & {*sys.modules}: sys.exit(f'{module} imports {heavy}')\n"
    )
    command = [sys.executable, "-W", "ignore", "-c", code, *TORCH_FREE]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("folder", ["bench", "examples"])
def test_what_scripts_import_from_the_package_is_there(folder: str) -> None:
    missing = []
    for path in sorted((PACKAGE.parent / folder).glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("gsencoder"):
                continue
            module = importlib.import_module(node.module or "")
            for alias in node.names:
                if not hasattr(module, alias.name) and find_spec(f"{node.module}.{alias.name}") is None:
                    missing.append(f"{path.name} line {node.lineno}: {node.module}.{alias.name}")
    assert missing == []
