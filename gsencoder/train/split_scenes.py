"""The scenes of a training: those to train on, and those held out for validation."""

from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path

from gsencoder.core.errors import InputError, listed
from gsencoder.core.first_repeated import first_repeated
from gsencoder.data.truth.split_files import read_split


def split_scenes(
    paths: Sequence[Path], patterns: Sequence[str], split: Path | None = None, holdout_split: Path | None = None
) -> tuple[list[Path], list[Path]]:
    """Splits scenes into those to train on and those held out for validation.

    Args:
        paths: all scenes.
        patterns: names of scenes to hold out, with * and ? as in file names.
        split: file of the names of the scenes to train on, one a line, such as scannetv2_train.txt; those that are
            neither in it nor held out are left out. None = all that are not held out.
        holdout_split: file of the names of the scenes to hold out, in place of patterns.

    Raises:
        InputError: a pattern matches no scene, a file names a scene that is not there, or one that the other file
            names too, all scenes are held out, or two scenes have the same name.
    """
    names = [path.name for path in paths]
    if (repeated := first_repeated(names)) is not None:
        raise InputError(f"paths: two scenes are called {repeated[0]!r}; prepared scenes need distinct names")
    for pattern in patterns:
        if not any(fnmatch(name, pattern) for name in names):
            raise InputError(
                f"holdout: no scene is called {pattern!r}; the scenes are {listed(names, 5)}; give names of these, or "
                "holdout=[] for none (experiments hold out scenes of the data that they are made for)"
            )
    if split is not None or holdout_split is not None:
        return _split_by_files(paths, patterns, split, holdout_split)
    is_held_out = [any(fnmatch(name, pattern) for pattern in patterns) for name in names]
    held_out = [path for path, held in zip(paths, is_held_out, strict=True) if held]
    training = [path for path, held in zip(paths, is_held_out, strict=True) if not held]
    if not training:
        raise InputError("holdout: matches every scene; at least one must remain for training")
    return training, held_out


def _split_by_files(
    paths: Sequence[Path], patterns: Sequence[str], split: Path | None, holdout_split: Path | None
) -> tuple[list[Path], list[Path]]:
    path_of = {path.name: path for path in paths}
    chosen: dict[str, tuple[str, ...]] = {}
    for option, file in (("split", split), ("holdout_split", holdout_split)):
        chosen[option] = read_split(file) if file is not None else ()
        missing = [name for name in chosen[option] if name not in path_of]
        if missing:
            raise InputError(
                f"{option}={file}: {len(missing)} of its {len(chosen[option])} scenes are not among those given, such "
                f"as {missing[0]!r}"
            )
    held_out = set(chosen["holdout_split"])
    if holdout_split is not None and patterns:
        raise InputError("holdout: expected holdout= or holdout_split=, got both; leave one out, or give holdout=[]")
    if holdout_split is None:
        held_out = {name for name in path_of if any(fnmatch(name, pattern) for pattern in patterns)}
    twice = sorted(held_out & set(chosen["split"])) if holdout_split is not None else []
    if twice:
        raise InputError(
            f"holdout_split={holdout_split}: {len(twice)} of its scenes are in split= too, such as {twice[0]!r}; a "
            "scene is trained on or held out"
        )
    trained = chosen["split"] if split is not None else tuple(path_of)
    training = [path_of[name] for name in trained if name not in held_out]
    if not training:
        raise InputError("holdout: matches every scene; at least one must remain for training")
    return training, [path for path in paths if path.name in held_out]
