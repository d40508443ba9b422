"""Imports go down only, and what a torch-free runtime needs does not import torch."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "gsencoder"

LEVELS = (
    ("core",),
    ("types",),
    ("geometry",),
    ("text", "data", "render"),
    ("models", "fusion", "reconstruct"),
    ("train", "infer"),
    ("evaluate",),
    ("app",),
    ("__main__",),
)
"""Lowest first. A part may import lower levels and itself; parts of one level do not know each other."""

RANK = {name: rank for rank, names in enumerate(LEVELS) for name in names}

TORCH_FREE = [
    "gsencoder",
    "gsencoder.types",
    "gsencoder.core.errors",
    "gsencoder.data.splats",
    "gsencoder.data.splat_formats.repair",
    "gsencoder.text.table",
    "gsencoder.core.files.archive",
    "gsencoder.fusion.basis",
    "gsencoder.fusion.checkpoint",
    "gsencoder.fusion.store.folder",
    "gsencoder.models.grid.curves",
    "gsencoder.infer.encode.chunks",
    "gsencoder.infer.load_encoder",
    "gsencoder.infer.onnx.header",
    "gsencoder.infer.onnx.runtime",
    "gsencoder.app.commands.encode",
    "gsencoder.text.encoder",
    "gsencoder.infer.localize.localize",
    "gsencoder.infer.draw.boxes_ply",
    "gsencoder.infer.draw.pictures",
    "gsencoder.infer.draw.report",
    "gsencoder.app.runs.output_folder",
    "gsencoder.app.settings.config",
    "gsencoder.app.settings.config_store",
    "gsencoder.app.settings.compose",
    "gsencoder.app.settings.multirun",
    "gsencoder.app.commands.inspect",
    "gsencoder.app.commands.repair",
    "gsencoder.app.cli",
]


def part_of(path: Path, package: Path = PACKAGE) -> str:
    """The part of the package that a file belongs to: a folder's name, or a top file's."""
    relative = path.relative_to(package)
    return relative.parts[0] if len(relative.parts) > 1 else relative.stem


def public_names() -> dict[str, str]:
    """The parts that the package's lazy names come from, such as `load_splat` from data."""
    import gsencoder

    return {name: home.split(".")[1] for name, home in gsencoder._HOME.items()}


def imports_of(source: str, module: str, lazy: dict[str, str]) -> list[tuple[int, str]]:
    """Line and part of every import of the package in a file, wherever it stands, also by `import_module("…")`.

    Args:
        source: the text of the file.
        module: its dotted name, for relative imports; that of a package ends in `.__init__`.
        lazy: the parts that names taken from `gsencoder` itself come from.
    """
    found = []
    for node in ast.walk(ast.parse(source)):
        names: list[str] = []
        line = getattr(node, "lineno", 0)
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(module.split(".")[: -node.level]) if node.level else ""
            base = ".".join(filter(None, [base, node.module]))
            names = [f"{base}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if name in ("import_module", "__import__") and isinstance(node.args[0].value, str):
                names = [node.args[0].value]
        for name in names:
            pieces = name.split(".")
            if pieces[0] == "gsencoder" and len(pieces) > 1:
                found.append((line, lazy.get(pieces[1], pieces[1])))
    return found


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
    assert {part_of(path) for path in files()} <= set(RANK)


@pytest.mark.parametrize("path", files(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_go_down_only(path: Path) -> None:
    module = ".".join(("gsencoder", *path.relative_to(PACKAGE).with_suffix("").parts))
    assert upward(path.read_text(encoding="utf-8"), module, public_names()) == []


def test_the_package_itself_imports_nothing_at_load() -> None:
    assert imports_of((PACKAGE / "__init__.py").read_text(), "gsencoder.__init__", {}) == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("gsencoder.render.blend", "import gsencoder.data.splats"),
        ("gsencoder.data.splats", "from gsencoder.render import blend"),
        ("gsencoder.data.splats", "from ..render import blend"),
        ("gsencoder.fusion.__init__", "from ..train.trainer import Trainer"),
        ("gsencoder.fusion.teachers.onnx", "def f():\n    from gsencoder.infer import text"),
        ("gsencoder.models.encoder", "from gsencoder.fusion.basis import fit"),
        ("gsencoder.types", "from gsencoder import load_splat"),
        ("gsencoder.core.errors", "import gsencoder.types"),
        ("gsencoder.text.encoder", "if True:\n    import gsencoder.evaluate.report as report"),
        ("gsencoder.render.blend", "import importlib\nimportlib.import_module('gsencoder.data.splats')"),
        ("gsencoder.evaluate.report", "from gsencoder.app.settings.config import CommonConfig"),
        ("gsencoder.infer.ask.ask", "from gsencoder.app import commands"),
    ],
)
def test_an_upward_import_is_found_wherever_it_hides(module: str, source: str) -> None:
    assert len(upward(source, module, {"load_splat": "data"})) == 1


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("gsencoder.fusion.fuse", "from gsencoder.render.blend import blend\nfrom ..data import scenes\nimport torch"),
        ("gsencoder.data.scenes", "from gsencoder.data.splats import read_raw\nfrom .colmap import read"),
        ("gsencoder.app.runs.summary", "import gsencoder\nfrom gsencoder import __version__"),
    ],
)
def test_a_downward_import_is_left_alone(module: str, source: str) -> None:
    assert upward(source, module, {}) == []


@pytest.mark.parametrize("module", TORCH_FREE)
def test_a_torch_free_module_does_not_import_torch(module: str) -> None:
    code = f"import sys, {module}; sys.exit('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr or f"{module} imports torch"
