"""Paths of scenes: which paths are scenes, the scenes in folders and lists of paths, and their names; and what other
paths are.

Judged by names of files alone; `scenes.py` reads them.
"""

import json
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.core.files import SUMMARY_NAME, read_foreign_text
from gsencoder.data.readers.layouts import describe_layouts, layout_of
from gsencoder.data.readers.scene_splat import SPLAT_SUFFIXES

FEATURES_FILE = "scene.safetensors"
"""The file by which a folder of features, or of a memory of a scene, is recognized."""
UNFINISHED_FILE = "unfinished.txt"
"""The file by which the state of an unfinished run is recognized."""


def find_scenes(paths: Iterable[str | Path]) -> tuple[Path, ...]:
    """The scenes at paths: a path is a scene, a folder of scenes, which are sorted by name, or a list of paths (.txt).

    A folder is a scene if `load_scene` recognizes it; of any other folder the direct subfolders are searched.

    Raises:
        InputError: a path does not exist, a folder holds no scene, or a scene is given twice, also by different paths.
    """
    scenes = DistinctPaths()
    for path in listed_paths(paths):
        try:
            if not path.exists():
                raise InputError(f"{path}: no such file or folder")
            scenes_of_path = [path] if is_scene(path) else sorted(filter(_is_scene_folder, path.iterdir()))
        except (OSError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{str(path)[:200]!r} cannot be read ({type(error).__name__})") from error
        if not scenes_of_path and (path / FEATURES_FILE).is_file():
            raise InputError(
                f"{path}: a folder of features, not a scene; localize, views, ask, pack and evaluate features= take it"
            )
        if not scenes_of_path:
            raise InputError(
                f"{path}: {kind_of_path(path)}, neither a scene nor a folder of scenes; a scene holds one of: "
                f"{describe_layouts()}; a splat"
            )
        scenes.add(scenes_of_path)
    return scenes.paths


class DistinctPaths:
    """Paths of scenes, of which none is given twice: whether the second was meant to be another, nobody can tell."""

    def __init__(self) -> None:
        self._by_target: dict[Path, Path] = {}

    @property
    def paths(self) -> tuple[Path, ...]:
        """In the order in which they were added."""
        return tuple(self._by_target.values())

    def add(self, paths: Iterable[Path]) -> None:
        """Adds paths.

        Raises:
            InputError: one is there already, also under another name or by a link.
        """
        for path in paths:
            target = path.resolve()
            first = self._by_target.get(target)
            if first == path:
                raise InputError(f"{path}: is given twice; give it once")
            if first is not None:
                raise InputError(f"{path}: is the same as {first}, which is given as well; give one of them")
            self._by_target[target] = path


def listed_paths(paths: Iterable[str | Path]) -> list[Path]:
    """Paths, with those in list files in place of the files: text files (.txt) with one path a line, relative to the
    file; blank lines and those that begin with # are left out.

    Raises:
        InputError: a list cannot be read, or is empty.
    """
    result: list[Path] = []
    for path in map(Path, paths):
        try:
            is_list = path.suffix.lower() == ".txt" and path.is_file()
        except (OSError, ValueError):
            is_list = False
        if not is_list:
            result.append(path)
            continue
        try:
            lines = read_foreign_text(path).splitlines()
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: not a readable list of scenes ({type(error).__name__})") from error
        names = [line.strip() for line in lines if line.strip() and not line.strip().startswith("#")]
        if not names:
            raise InputError(f"{path}: lists no scene; expected one path a line")
        result += [path.parent / name for name in names]
    return result


def is_scene(path: Path) -> bool:
    """Whether `load_scene` recognizes a folder itself as a scene; True for any file."""
    if path.is_file():
        return True
    return (
        (path / "meta.json").is_file()
        or layout_of(path) is not None
        or any(entry.suffix.lower() in SPLAT_SUFFIXES and entry.is_file() for entry in path.iterdir())
    )


def _is_scene_folder(entry: Path) -> bool:
    return entry.is_dir() and not entry.name.startswith(".") and is_scene(entry)


def has_views(path: Path) -> bool:
    """Whether a path is a scene with posed views, as opposed to a splat, judged by names of files alone."""
    return is_transforms_file(path) if path.is_file() else layout_of(path) is not None


def is_transforms_file(path: Path) -> bool:
    """Whether a file is to be read as transforms.json: any .json but the meta.json of an unpacked .sog."""
    return path.suffix.lower() == ".json" and path.name != "meta.json"


def scene_name(path: Path) -> str:
    """The name that `load_scene` gives the scene at an existing path."""
    if path.is_file():
        return name_of_folder(path.absolute().parent) if is_transforms_file(path) else path.stem
    return name_of_folder(path)


def name_of_folder(folder: Path) -> str:
    """The name of a scene and of its output folder; "." and ".." are resolved."""
    return (folder if folder.name not in ("", "..") else folder.resolve()).name or "scene"


def check_names(paths: Sequence[Path]) -> None:
    """Checks that no two scenes have the same name, since their results would be in one folder.

    Raises:
        InputError: two have.
    """
    first: dict[str, Path] = {}
    for path in paths:
        name = scene_name(path)
        if name in first:
            raise InputError(
                f"{path} and {first[name]} are both called {name!r}, so their results would be in one folder; "
                "rename one, or run them with different out="
            )
        first[name] = path


def kind_of_path(path: str | Path) -> str:
    """What a path is, judged by names of files and by the record of the run that wrote it: such as "a folder that
    `gsencoder fuse` wrote", or "an empty folder"."""
    path = Path(path)
    with suppress(OSError, ValueError):
        if path.is_dir():
            return _kind_of_folder(path)
        if path.is_file():
            if path.suffix.lower() in SPLAT_SUFFIXES:
                return "a splat"
            return f"a {path.suffix.lower()} file" if path.suffix else "a file"
    return "no file or folder"


def _kind_of_folder(folder: Path) -> str:
    with suppress(OSError, ValueError, TypeError, AttributeError):
        command = json.loads(read_foreign_text(folder / SUMMARY_NAME))["command"]
        if isinstance(command, str) and command.isalpha() and len(command) < 20:
            return f"a folder that `gsencoder {command}` wrote"
    if (folder / UNFINISHED_FILE).is_file():
        return "the state of an unfinished run, which its command continues"
    if (folder / FEATURES_FILE).is_file():
        return "a folder of features"
    if is_scene(folder):
        return "a scene"
    entries = list(folder.iterdir())
    if not entries:
        return "an empty folder"
    inner = sorted(entry for entry in entries if entry.is_dir() and (entry / FEATURES_FILE).is_file())
    if inner:
        return f"a folder of folders of features ({inner[0].name}, …)"
    return "a folder of other files"
