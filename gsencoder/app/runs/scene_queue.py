"""Runs of one command over many scenes: finished ones are skipped, failures wait for the end, and several processes may
share the scenes."""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from gsencoder.app.runs.printable import one_line
from gsencoder.app.runs.summary import Summary
from gsencoder.core.errors import BusyError, InputError, listed
from gsencoder.core.files import SUMMARY_NAME, plain, read_foreign_text
from gsencoder.core.process import refuse_several
from gsencoder.data.scenes import check_names, scene_name

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
        paths: the scenes.
        out: the folder; None = outputs/NAME/PART.
        part: what the results are called there.
        run: does one scene.
        summary: of the whole run; that of a single scene.
        overwrite: whether finished scenes are done again.
        worker: number of this process among several that share the scenes; each begins at another one.
        screen: for lines about scenes that are skipped.

    Raises:
        InputError: two scenes have one name, the error of the only scene, several processes for it, or some of several
            scenes failed.
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
    """Whether a folder holds the results of this command with these settings.

    Raises:
        InputError: it holds results of others.
    """
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
