"""The scenes of a training: those to train on, and those held out for validation."""

from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError, listed
from gsencoder.data.labels.files import read_split


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
    trained = _names_of("split", split, names) or tuple(names)
    held_out = set(_names_of("holdout_split", holdout_split, names))
    if holdout_split is None:
        held_out = {name for name in names if any(fnmatch(name, pattern) for pattern in patterns)}
    elif patterns:
        raise InputError("holdout: expected holdout= or holdout_split=, got both; leave one out, or give holdout=[]")
    elif split is not None and (twice := sorted(held_out.intersection(trained))):
        raise InputError(
            f"holdout_split={holdout_split}: {len(twice)} of its scenes are in split= too, such as {twice[0]!r}; a "
            "scene is trained on or held out"
        )
    path_of = dict(zip(names, paths, strict=True))
    training = [path_of[name] for name in trained if name not in held_out]
    if not training:
        raise InputError("holdout: matches every scene; at least one must remain for training")
    return training, [path for path in paths if path.name in held_out]


def _names_of(option: str, file: Path | None, scenes: Sequence[str]) -> tuple[str, ...]:
    """The names in a split file, none without a file; all must be among those given."""
    if file is None:
        return ()
    chosen, possible = read_split(file), frozenset(scenes)
    missing = [name for name in chosen if name not in possible]
    if missing:
        raise InputError(
            f"{option}={file}: {len(missing)} of its {len(chosen)} scenes are not among those given, such as "
            f"{missing[0]!r}"
        )
    return chosen
