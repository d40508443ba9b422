"""Folders that a block writes into."""

from pathlib import Path
from typing import Any

from gsencoder.app.output import Summary, output_folder


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def write_and_raise(path: Path, error: BaseException, **options: Any) -> None:
    with output_folder(path, **options) as folder:
        (folder / "a").write_text("x")
        raise error


def fill(path: Path, text: str, **options: Any) -> None:
    with output_folder(path, summary=Summary("fuse", {"voxel": 0.02}), **options) as folder:
        (folder / "deep").mkdir()
        (folder / "deep" / "data.txt").write_text(text)
