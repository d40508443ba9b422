"""Scenes and words that commands read without torch: the queue of scenes, which way is up, what is asked for."""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from gsencoder.app.options import CommonConfig
from gsencoder.app.progress import console
from gsencoder.app.summary import Summary
from gsencoder.core.errors import BusyError, InputError, listed, one_line
from gsencoder.core.files import (
    SUMMARY_NAME,
    plain,
    read_foreign_text,
)
from gsencoder.core.pretrained import find_file
from gsencoder.core.process import refuse_several
from gsencoder.core.settings import option
from gsencoder.data.scenes import SceneConfig, check_names, load_scene, scene_name
from gsencoder.data.up import with_up
from gsencoder.fusion.folder import WORDS_FILE, load_features, table_path
from gsencoder.infer.localize import select_features
from gsencoder.infer.views.photographs import with_photographs
from gsencoder.text.table import TextTable, load_text_table
from gsencoder.text.vocabulary import (
    TableTextConfig,
    TextConfig,
    Words,
    stating_trained,
    vocabulary_of,
    words_of_table,
)
from gsencoder.types import FeatureSpace, Scene

MAX_QUERIES_BYTES = 1 << 20
"""Largest size of a file of queries, bytes."""


def query_words(query: Sequence[str], queries: str) -> list[str]:
    """The words of query= and of the file queries=, stripped, without repetitions, in order."""
    lines = list(query)
    if queries:
        lines += _lines_of(Path(queries))
    words = list(dict.fromkeys(line.strip() for line in lines if line.strip()))
    if not words:
        raise InputError("query= is missing: one or several words, separated by commas (or queries=FILE)")
    return words


def _lines_of(file: Path) -> list[str]:
    """The lines of a text file, which may begin with a byte order mark."""
    try:
        return read_foreign_text(file, MAX_QUERIES_BYTES).splitlines()
    except InputError as error:
        raise InputError(f"queries: {error}") from error
    except (OSError, ValueError) as error:
        raise InputError(f"queries: {file} cannot be read as text: {error}") from error


def queried_scene(
    scene: Scene,
    folder: Path,
    *,
    head: str = "",
    space: str = "",
    words_file: str = "",
    text: TextConfig = TableTextConfig(),
) -> tuple[Scene, Words]:
    """A scene with the one feature set that words are compared with, and the words.

    Args:
        head: name of an adapter head; empty = the features themselves are asked.
        space: name of the feature set; empty where there is only one.
        words_file: a file of words; empty = those beside the features, or for a head those of `text`.
    """
    if head:
        # Heads need torch, which finding boxes does without.
        from gsencoder.app.heads import queried_through_head

        return queried_through_head(scene, folder, head, space=space, words_file=words_file, text=text)
    _, features = select_features(scene, space or None)
    words = load_words(folder, features.space, words_file, text)
    return replace(scene, features={features.space.name: features}), words


def shown_scene(folder: Path, photos: str, options: SceneConfig) -> Scene:
    """Loads a folder of features, with the photographs of the scene `photos` if one is given."""
    scene = load_features(folder)
    return with_photographs(scene, load_scene(photos, options=options)) if photos else scene


@dataclass(frozen=True, kw_only=True)
class WordsOptions(CommonConfig):
    """Which words are compared with which features. Without slots, as `CommonConfig`."""

    words: str = option("", "text table; empty = the one in the folder of the features")
    space: str = option("", "name of the feature space, if the folder holds several")
    head: str = option(
        "",
        "adapter head whose outputs are compared with the words of text=, such as siglip; empty = the "
        "features themselves are",
    )


def with_reported_up(scene: Scene, summary: Summary, *, quiet: bool) -> Scene:
    """The scene with `up`, which the summary records; an estimate is printed."""
    scene, up = with_up(scene)
    summary.results["up"] = None if up is None else up.to_dict()
    if up is not None and up.source != "stated":
        console(quiet).print(f"up of {scene.name}: {up.describe()} (data.up= states it)")
    return scene


def load_words(folder: Path, space: FeatureSpace, words_file: str, text: TextConfig = TableTextConfig()) -> Words:
    """The text table that was given, or the one in the folder of the features, with the tower that made it.

    Args:
        space: of the features that are asked; folders with several may hold words for each.
        words_file: a file of words; empty = the one in the folder.
        text: a tower that is given; otherwise it is searched for when a phrase needs it.
    """
    if words_file:
        words = words_of_table(load_text_table(find_file(words_file, "words")), text)
        return stating_trained(words, _table_beside(folder, space))
    if not isinstance(text, TableTextConfig):
        table = _table_beside(folder, space)
        return vocabulary_of(text) if table is None else words_of_table(table, text)
    path = table_path(folder, space.text_encoder)
    if path is None:
        raise InputError(
            f"{folder}: there is no {WORDS_FILE} beside these features: no words lead into them, or the file was lost; "
            "fuse with a teacher that has words, or give words= or text="
        )
    return words_of_table(load_text_table(path))


def _table_beside(folder: Path, space: FeatureSpace) -> TextTable | None:
    """The table of a space in a folder of features; None where it is lost, damaged or of another space, for which
    words= and text= stand in."""
    try:
        path = table_path(folder, space.text_encoder)
        table = None if path is None else load_text_table(path)
    except InputError:
        return None
    return table if table is not None and table.space.text_encoder == space.text_encoder else None


NOT_COMPARED = ("paths", "out", "overwrite", "quiet", "worker", "resume", "device", "preset")
"""Settings in which two runs with the same results may differ; what a preset sets is compared."""


GOLDEN = 0.6180339887
"""Workers begin at the fractional parts of its multiples, which are spread evenly however many there are."""


class ScenesFailedError(InputError):
    """Some of several scenes failed, each of which was said when it did.

    Attributes:
        reasons: one line a scene.
    """

    def __init__(self, message: str, reasons: tuple[str, ...]) -> None:
        super().__init__(message)
        self.reasons = reasons


RunOne = Callable[[Path, Path, Summary], None]
"""Does one scene: its path, the folder for its results, and the summary that goes into it."""


def run_scenes(
    paths: Sequence[Path],
    out: Path | None,
    part: str,
    run: RunOne,
    summary: Summary,
    *,
    overwrite: bool,
    worker: int,
    screen: Console,
) -> None:
    """Runs a command for one scene into `out`, or for each of several into the folder OUT/NAME.

    Of several scenes those are skipped whose folder holds the results of the same settings, and those that another
    process is writing now. An error in one does not stop the others. The summary of each has its own
    warnings, and those from before the first; that of the run has all, with the names of scenes.

    Args:
        part: what the results are called there.
        summary: of the whole run; that of a single scene.
        overwrite: whether finished scenes are done again.
        worker: number of this process among several that share the scenes; each begins at another one.
        screen: for lines about scenes that are skipped.
    """
    check_names(paths)
    if len(paths) == 1:
        refuse_several(f"{paths[0]}", "start it once, or give several scenes, which processes share")
        name = scene_name(paths[0])
        run(paths[0], out or Path("outputs") / name / part, summary)
        return
    first = int(len(paths) * ((worker * GOLDEN) % 1))
    failures: dict[Path, str] = {}
    common = tuple(summary.warnings)
    skipped = 0
    for path in (*paths[first:], *paths[:first]):
        name = scene_name(path)
        target = out / name if out is not None else Path("outputs") / name / part
        try:
            if not overwrite and _is_finished(target, summary):
                skipped += 1
                continue
            with summary.of_scene(name, path, common) as summary_of_scene:
                run(path, target, summary_of_scene)
        except BusyError:
            screen.print(f"{target}: another run is writing it now")
        except InputError as error:
            if not overwrite and _was_finished(target, summary):
                continue
            failures[path] = str(error) if str(error).startswith(f"{path}: ") else f"{path}: {error}"
            print(one_line(f"failed: {failures[path]}"), file=sys.stderr)
    if skipped:
        screen.print(f"{skipped} of {len(paths)} scenes were finished before")
    if failures:
        raise ScenesFailedError(
            f"{len(failures)} of {len(paths)} scenes failed, and the same command tries them again: "
            f"{listed([str(path) for path in failures])}",
            tuple(failures.values()),
        )


def _was_finished(target: Path, summary: Summary) -> bool:
    """Whether another process has finished the scene in the meantime."""
    try:
        return _is_finished(target, summary)
    except InputError:
        return False


def _is_finished(target: Path, summary: Summary) -> bool:
    """Whether a folder holds the results of this command with these settings."""
    try:
        record = json.loads(read_foreign_text(target / SUMMARY_NAME))
    except FileNotFoundError:
        return False
    except (OSError, ValueError) as error:
        raise InputError(f"{target / SUMMARY_NAME}: cannot be read ({type(error).__name__})") from error
    now = {"command": summary.command, **_compared(json.loads(json.dumps(plain(summary.settings))))}
    before = {"command": record.get("command"), **_compared(record.get("settings", {}))}
    differing = sorted(key for key in {*now, *before} if now.get(key) != before.get(key))
    if differing:
        raise InputError(
            f"{target}: holds the results of other settings ({', '.join(differing[:5])}); give another out= or "
            "overwrite=true"
        )
    return True


def _compared(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in settings.items() if key not in NOT_COMPARED}
