"""Hooks of mkdocs: pages of the site that are not in docs/, and links between files of the repository.

Links stay as GitHub shows them, relative to the file that they stand in; here they are led to the pages of the site.
"""

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import gsencoder

ROOT = Path(__file__).resolve().parents[2]
OUTSIDE = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changes.md",
    "gsencoder/weights/README.md": "weights.md",
}
"""Pages of the site by files of the repository outside of docs/."""
LINK = re.compile(r"(!?\[[^\]]*\]\()([^)\s]+)\)")


def example_pages() -> dict[str, str]:
    """The page of each numbered example, by its file."""
    return {f"examples/{path.name}": f"examples/{path.stem}.md" for path in sorted((ROOT / "examples").glob("*.py"))}


def packages_of(folder: Path) -> Iterator[Path]:
    """The folders of the package that the reference describes, each before those below it; `app` is left out."""
    for path in sorted(folder.iterdir()):
        if (path / "__init__.py").exists() and path != ROOT / "gsencoder" / "app":
            yield path
            yield from packages_of(path)


def api_pages() -> dict[str, str]:
    """The pages of the reference, which mkdocstrings fills: one for each folder of the package that has modules."""
    pages = {"api/geometry.md": "# geometry\n\n::: gsencoder.geometry\n"}
    for folder in packages_of(ROOT / "gsencoder"):
        name = ".".join(folder.relative_to(ROOT).parts)
        short = name.removeprefix("gsencoder.")
        modules = sorted(path.stem for path in folder.glob("*.py") if path.stem not in ("__init__", "__main__"))
        options = "{members: false, show_root_heading: false, show_root_toc_entry: false}"
        blocks = [f"# {short}", f"::: {name}\n    options: {options}"]
        blocks += [f"::: {name}.{module}" for module in modules]
        if modules:
            pages[f"api/{short}.md"] = "\n\n".join(blocks) + "\n"
    return dict(sorted(pages.items(), key=lambda page: page[0].removesuffix(".md")))


def public_names() -> str:
    """The page of the names that `gsencoder` itself has."""
    rows = []
    for name in gsencoder.__all__:
        value = getattr(gsencoder, name)
        line = re.sub(r"\s+", " ", (value.__doc__ or "").strip().split("\n\n")[0])
        line = line.replace("*", "\\*")
        rows.append(f"| [`{name}`][{value.__module__}.{value.__qualname__}] | {line} |")
    text = (
        "# Public names\n\n`from gsencoder import …` has these names; each is loaded when it is first used. "
        "Everything else is reached by its module, on the pages of the folders. `gsencoder.app`, the command line, is "
        "described in [Options and commands](../commands.md).\n\n| name | what it is |\n|---|---|\n"
    )
    return text + "\n".join(rows) + "\n"


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Puts the pages of the reference into the navigation, where mkdocs.yml has an empty list for them."""
    assert config.nav is not None
    for entry in config.nav:
        if "API" in entry:
            entry["API"] = [{"Public names": "api/index.md"}]
            entry["API"] += [{page[len("api/") : -len(".md")]: page} for page in api_pages()]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages that are not in docs/."""
    for source, page in OUTSIDE.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    for source, page in example_pages().items():
        code = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=f"# {source}\n\n```python\n{code}```\n"))
    for page, text in {**api_pages(), "api/index.md": public_names()}.items():
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001
    """Leads links between files of the repository to the pages of the site."""
    pages = {**OUTSIDE, **example_pages()}
    here = page.file.src_uri
    if here.startswith("api/"):
        return markdown
    source = next((name for name, uri in pages.items() if uri == here), f"docs/{here}")

    def led(match: re.Match[str]) -> str:
        link, _, fragment = match[2].partition("#")
        if not link or re.match(r"\w+:", link):
            return match[0]
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), link))
        uri = pages.get(target, target.removeprefix("docs/"))
        relative = posixpath.relpath(uri, posixpath.dirname(here) or ".")
        return f"{match[1]}{relative}{'#' if fragment else ''}{fragment})"

    return LINK.sub(led, markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001
    """Lets long names in tables break after dots, underscores, slashes, commas and equal signs."""

    def breakable(table: re.Match[str]) -> str:
        return re.sub(r"(?<=<code>)[^<]+", lambda name: re.sub(r"([._/,=])(?=\w)", r"\1<wbr>", name[0]), table[0])

    return re.sub(r"<table>.*?</table>", breakable, html, flags=re.DOTALL)
