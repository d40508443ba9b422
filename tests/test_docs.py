"""The documents are true: links and paths lead somewhere, names can be imported, commands have their options."""

import ast
import importlib
import re
from functools import cache
from pathlib import Path

import pytest

from gsencoder.app.commands import COMMANDS
from gsencoder.app.settings.compose import choices_of, read_words
from gsencoder.core.errors import InputError

ROOT = Path(__file__).resolve().parent.parent
# docs/commands.md adds a command of its own; tests/app/test_commands_page.py runs it.
PAGES = sorted({*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")} - {ROOT / "docs" / "commands.md"})
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def pages(pattern: re.Pattern[str], *, code: bool) -> list[tuple[str, re.Match[str]]]:
    """Every match of a pattern in the pages, with the page's name; outside code blocks unless `code`."""
    texts = {page: page.read_text(encoding="utf-8") for page in PAGES}
    if not code:
        texts = {page: FENCE.sub("", text) for page, text in texts.items()}
    return [(str(page.relative_to(ROOT)), match) for page, text in texts.items() for match in pattern.finditer(text)]


def anchor(heading: str) -> str:
    """The anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def names(cases: list[tuple[str, re.Match[str]]], group: int) -> list[tuple[str, str]]:
    return sorted({(page, match[group]) for page, match in cases})


LINKS = names(pages(re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)"), code=False), 1)
PATHS = names(pages(re.compile(r"`((?:gsencoder|tests|bench|docs|conf|examples)/[\w./]*\w)`"), code=False), 1)
DOTTED = names(pages(re.compile(r"`(gsencoder(?:\.\w+)+)(?:\(.*?\))?`"), code=False), 1)
PYTHON = [(page, match[2]) for page, match in pages(FENCE, code=True) if match[1] == "python"]
SHELL = [
    (page, " ".join(line.split("#")[0].split()))
    for page, match in pages(FENCE, code=True)
    if match[1] in ("bash", "sh", "")
    for line in match[2].replace("\\\n", " ").splitlines()
    if re.match(r"\s*(.*-m )?gsencoder \w", line)
]


@pytest.mark.parametrize(("page", "link"), LINKS)
def test_a_link_leads_somewhere(page: str, link: str) -> None:
    if re.match(r"\w+://", link):
        pytest.skip("outside")
    path, _, part = link.partition("#")
    target = (ROOT / page).parent / path if path else ROOT / page
    assert target.exists()
    if part:
        headings = re.findall(r"^#+ (.*)$", FENCE.sub("", target.read_text(encoding="utf-8")), re.MULTILINE)
        assert part in [anchor(heading) for heading in headings]


@pytest.mark.parametrize(("page", "path"), PATHS)
def test_a_path_exists(page: str, path: str) -> None:
    assert (ROOT / path).exists() or "NAME" in path


def resolve(name: str) -> object:
    """The module, function, class or attribute of a dotted name."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            found = getattr(found, part, None) or found.__dataclass_fields__[part]  # type: ignore[attr-defined]
        return found
    raise ModuleNotFoundError(name)


@pytest.mark.parametrize(("page", "name"), DOTTED)
def test_a_dotted_name_can_be_imported(page: str, name: str) -> None:
    if "NAME" not in name:
        resolve(name)


@pytest.mark.parametrize(("page", "code"), PYTHON, ids=lambda text: text if text.endswith(".md") else "")
def test_python_code_compiles_and_its_imports_are_there(page: str, code: str) -> None:
    for node in ast.walk(ast.parse(code, page)):
        if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] == "gsencoder":
            for alias in node.names:
                resolve(f"{node.module}.{alias.name}")


@cache
def choices(command: str):  # type: ignore[no-untyped-def]
    return choices_of(COMMANDS[command].load()[0])


@pytest.mark.parametrize(("page", "line"), SHELL)
def test_a_command_line_has_commands_and_options_that_are_there(page: str, line: str) -> None:
    words = re.split(r"(?:^|\s)gsencoder ", line, maxsplit=1)[1].split(" ")
    command = words[0].strip("`")
    if command == "COMMAND":
        return
    assert command in COMMANDS
    for word in re.findall(r"""(?:^|\s)([\w./]+=)(?:'[^']*'|"[^"]*"|\S*)""", " ".join(words[1:])):
        try:
            read_words([f"{word}x"], choices(command), sweep="-m" in words)
        except InputError as error:
            pytest.fail(str(error))


def test_the_documents_are_looked_at() -> None:
    assert len(PAGES) > 5
    assert len(LINKS) > 5
    assert len(SHELL) > 20
    assert len(PYTHON) > 1
