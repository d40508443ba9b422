"""The documents are true: links, paths, names and make targets exist; code blocks and command lines fit the package."""

import ast
import importlib
import importlib.util
import inspect
import re
import shlex
import sys
import textwrap
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest

import gsencoder
from gsencoder.app.compose import overrides, read_words
from gsencoder.app.main import COMMANDS
from gsencoder.app.options import Choices, choices_of
from gsencoder.core.errors import InputError

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "gsencoder"
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")] + sorted(
    page for folder in ("docs", "docs/tasks") for page in (ROOT / folder).glob("*.md")
)
RESULTS = sorted((ROOT / "docs" / "results").glob("*.md"))
"""Figures of the commits that measured them, which may name options and scripts that are gone."""
HISTORY = ("CHANGELOG.md", "decisions.md", "measurements.md")
"""Pages that also speak of options and modules that are gone."""

FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
PLACEHOLDER = re.compile(r"\b[A-Z]{3,}\b|…|\*")
"""NAME, OUT, …, * stand for something that the reader puts in."""
TOP_FOLDERS = "gsencoder|tests|bench|docs|conf|examples"
SUBFOLDERS = "|".join(sorted(path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name != "__pycache__"))

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


@cache
def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


@cache
def prose_of(page: Path) -> str:
    """A page without its code blocks."""
    return FENCE.sub("", text_of(page))


@cache
def inline_code_of(page: Path) -> tuple[str, ...]:
    """What stands between backticks in the prose."""
    return tuple(re.findall(r"`([^`]+)`", prose_of(page)))


def blocks_of(page: Path, *languages: str) -> list[str]:
    return [code for language, code in FENCE.findall(text_of(page)) if language in languages]


def anchor_of(heading: str) -> str:
    """The anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def links_of(page: Path) -> list[str]:
    links = re.findall(r"!?\[[^\]]*\]\(([^)\s]+)\)", prose_of(page))
    return [link for link in links if not re.match(r"\w+:", link)]


def has_target(page: Path, link: str) -> bool:
    path, _, fragment = link.partition("#")
    target = page.parent / path if path else page
    if not fragment:
        return target.exists()
    return target.is_file() and fragment in map(anchor_of, re.findall(r"^#+ (.*)$", prose_of(target), re.MULTILINE))


@pytest.mark.parametrize("page", PAGES + RESULTS, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(page: Path) -> None:
    assert [link for link in links_of(page) if not has_target(page, link)] == []


def paths_of(page: Path) -> set[str]:
    """Paths of the repository; in inline code those of the package may leave out its name (`fusion/fuse.py`)."""
    paths = set(re.findall(rf"(?<![\w./-])(?:{TOP_FOLDERS})/[\w.*/-]+\.\w+", text_of(page)))
    for code in inline_code_of(page):
        if re.fullmatch(rf"(?:{TOP_FOLDERS})/[\w./-]*", code):
            paths.add(code)
        elif re.fullmatch(rf"(?:{SUBFOLDERS})/[\w./-]*", code):
            paths.add(f"gsencoder/{code}")
    return {path for path in paths if not PLACEHOLDER.search(path)}


@each_page
def test_paths_exist(page: Path) -> None:
    assert sorted(path for path in paths_of(page) if not (ROOT / path).exists()) == []


def is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False


@cache
def resolve(name: str) -> object:
    """The object of a dotted name; of a module that exists, its name alone.

    Raises:
        AttributeError: there is no such object.
    """
    parts = name.split(".")
    depth = max(count for count in range(1, len(parts) + 1) if is_module(".".join(parts[:count])))
    if depth == len(parts):
        return name
    value: object = importlib.import_module(".".join(parts[:depth]))
    for part in parts[depth:]:
        # A field without a default is no attribute of its dataclass.
        value = getattr(value, "__dataclass_fields__", {}).get(part) or getattr(value, part)
    return value


def resolves(name: str) -> bool:
    try:
        return resolve(name) is not None
    except AttributeError:
        return False


def dotted_names_of(page: Path) -> set[str]:
    """Names below `gsencoder`, and attributes of public classes and of the types (`Cameras.project`)."""
    names = set(re.findall(r"(?<![\w./-])gsencoder(?:\.[A-Za-z_]\w*)+", prose_of(page)))
    for code in inline_code_of(page):
        match = re.match(r"([A-Z]\w*)\.(\w+)", code)
        for home in ("gsencoder", "gsencoder.types"):
            if match and resolves(f"{home}.{match[1]}"):
                names.add(f"{home}.{match[0]}")
    return {name for name in names if not PLACEHOLDER.search(name)}


@each_page
def test_dotted_names_can_be_imported(page: Path) -> None:
    assert sorted(name for name in dotted_names_of(page) if not resolves(name)) == []


def imports_of(tree: ast.AST) -> dict[str, str]:
    """Dotted names of the package by the names that Python code gives them."""
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "gsencoder":
            names |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names if alias.name.split(".")[0] == "gsencoder"]
            names |= {module: module for module in modules}
    return names


def calls_that_do_not_bind(tree: ast.AST) -> Iterator[str]:
    """Calls of imported functions and classes of the package that their signatures refuse."""
    names = imports_of(tree)
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name) or node.func.id not in names:
            continue
        function = resolve(names[node.func.id])
        starred = any(isinstance(each, ast.Starred) for each in node.args) or any(
            not each.arg for each in node.keywords
        )
        if not callable(function) or starred:
            continue
        try:
            inspect.signature(function).bind(*node.args, **{str(each.arg): each.value for each in node.keywords})
        except ValueError:  # Exceptions have no signature.
            continue
        except TypeError as error:
            yield f"{ast.unparse(node)}: {error}"


@each_page
def test_python_blocks_import_and_call_what_is_there(page: Path) -> None:
    for code in blocks_of(page, "python"):
        tree = ast.parse(code)
        assert [name for name in imports_of(tree).values() if not resolves(name)] == []
        assert list(calls_that_do_not_bind(tree)) == []


@pytest.mark.parametrize("page", sorted((ROOT / "docs" / "tasks").glob("*.md")), ids=lambda page: page.name)
def test_code_of_the_task_pages_is_that_of_the_examples(page: Path) -> None:
    examples = "\n".join(text_of(path) for path in sorted((ROOT / "examples").glob("*.py")))
    blocks = blocks_of(page, "python")
    assert blocks
    for block in blocks:
        assert textwrap.indent(block.rstrip(), "    ") in examples


def command_lines_of(page: Path) -> list[str]:
    """What follows `gsencoder` in shell blocks and in inline code."""
    lines = [line for block in blocks_of(page, "bash", "sh", "") for line in block.replace("\\\n", " ").splitlines()]
    matches = (re.search(r"(?:^|\s)gsencoder\s+(\w.*)", line) for line in [*lines, *inline_code_of(page)])
    return [match[1] for match in matches if match]


@cache
def choices(command: str) -> Choices:
    return choices_of(COMMANDS[command].load()[0])


def complaint(line: str, made_on_the_page: set[str]) -> str:
    """What is wrong with a command line; empty where nothing is."""
    command, *words = shlex.split(line, comments=True)
    if command in made_on_the_page or PLACEHOLDER.fullmatch(command):
        return ""
    if command not in COMMANDS:
        return f"{command}: no such command"
    sweep = "-m" in words
    # A key alone (`query=`) and a placeholder (`form=FORM`) stand for any value.
    settings = [word for word in words if re.match(r"[\w./]+=", word)]
    any_value = {word for word in settings if PLACEHOLDER.search(word.partition("=")[2]) or word.endswith("=")}
    try:
        read_words(sorted(any_value), choices(command), sweep=sweep)
        _, texts = read_words([word for word in settings if word not in any_value], choices(command), sweep=sweep)
        overrides(
            {key: value for key, value in texts.items() if not key.startswith("hydra")}, choices(command), sweep=sweep
        )
    except InputError as error:
        return f"{line}: {error}"
    return ""


@each_page
def test_command_lines_have_commands_options_and_choices_that_are_there(page: Path) -> None:
    # tests/app/test_commands_page.py runs the command that docs/commands.md makes.
    made_on_the_page = set(re.findall(r'Command\(name="(\w+)"', text_of(page)))
    complaints = [complaint(line, made_on_the_page) for line in command_lines_of(page)]
    assert list(filter(None, complaints)) == []


def test_a_wrong_command_line_is_reported() -> None:
    good = ["fuse SCENE teacher=palette out=features  # a comment", "localize features query=", "views --help"]
    assert [complaint(line, set()) for line in good] == ["", "", ""]
    for bad in ("fuze SCENE", "fuse SCENE teecher=palette", "fuse SCENE teacher=palett", "fuse SCENE out=a out=b"):
        assert complaint(bad, set())


@cache
def all_keys() -> frozenset[str]:
    """Options and choices of all commands, with and without their sections."""
    keys = {key for command in COMMANDS for key in (*choices(command).options, *choices(command).groups)}
    return frozenset(keys | {re.split(r"[./]", key)[-1] for key in keys} | {"experiment"})


@each_page
def test_options_in_the_text_are_those_of_a_command(page: Path) -> None:
    if page.name not in HISTORY and page.name != "commands.md":
        keys = (re.match(r"([a-z_][\w./]*)=(?!=)", code) for code in inline_code_of(page))
        assert sorted({match[1] for match in keys if match} - all_keys()) == []


@each_page
def test_make_targets_exist(page: Path) -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    calls = set(re.findall(r"(?:^|\s|`)make ((?:[A-Z]+=\S+ )?[a-z][\w-]*)(?=`|\s+#|$)", text_of(page), re.MULTILINE))
    assert {name.split()[-1] for name in calls} <= targets


def loaded(name: str) -> ModuleType:
    """A script of docs/tooling."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / "tooling" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    # Its dataclasses look up the names of their module.
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def test_the_reference_of_the_command_line_is_what_make_cli_writes() -> None:
    assert text_of(ROOT / "docs" / "cli.md") == loaded("cli_page").page()


def test_every_document_is_in_the_navigation_of_the_site() -> None:
    listed = set(re.findall(r": ([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    documents = [page.relative_to(ROOT / "docs") for page in PAGES + RESULTS if ROOT / "docs" in page.parents]
    assert {page.as_posix() for page in documents} <= listed


def test_the_documents_are_looked_at() -> None:
    for contents, at_least in ((links_of, 20), (paths_of, 60), (dotted_names_of, 90), (command_lines_of, 30)):
        assert sum(len(contents(page)) for page in PAGES) >= at_least  # type: ignore[operator]
    assert sum(len(blocks_of(page, "python")) for page in PAGES) >= 4
    assert {"fuse", "Encoder", "localize"} <= set(gsencoder.__all__)
