"""A cache of phrases and their vectors on disk, one file for each tower and set of templates.

Loading a tower takes longer than embedding a word, and a vocabulary of thousands takes seconds. The file is an archive
with checksums. It holds nothing that cannot be computed again, so a damaged one is replaced, with a warning.
"""

import hashlib
import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError, SceneWarning

CACHE_VARIABLE = "GSENCODER_CACHE"
"""A folder; "off" = no cache; not set = gsencoder in the user's folder of caches."""
OFF = "off"
MAX_PHRASES = 20_000
"""A file that would grow beyond is begun anew."""


def cache_folder() -> Path | None:
    """The folder of cached vectors, or None where caching is off."""
    stated = os.environ.get(CACHE_VARIABLE, "")
    if stated == OFF:
        return None
    if stated:
        return Path(stated) / "text"
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "gsencoder" / "text"


def cached_vectors(
    identity: str,
    templates: Sequence[str],
    phrases: Sequence[str],
    compute: Callable[[list[str]], Float32[np.ndarray, "missing D"]],
) -> Float32[np.ndarray, "Q D"]:
    """The vectors of phrases, from the cache where it has them.

    Args:
        identity: of the tower.
        templates: that phrases are put into.
        phrases: to be embedded.
        compute: embeds those that the cache does not have; called only if there are such.

    Warns:
        SceneWarning: the file of the cache is damaged, or cannot be written.
    """
    path = _file_of(identity, templates)
    cached = _read(path) if path is not None else {}
    missing = list(dict.fromkeys(phrase for phrase in phrases if phrase not in cached))
    if missing:
        computed = dict(zip(missing, compute(missing), strict=True))
        if path is not None:
            _write(path, computed if len(cached) + len(computed) > MAX_PHRASES else cached | computed)
        cached = cached | computed
    return np.stack([cached[phrase] for phrase in phrases])


def _file_of(identity: str, templates: Sequence[str]) -> Path | None:
    folder = cache_folder()
    if folder is None:
        return None
    digest = hashlib.sha256(repr((identity, tuple(templates))).encode("utf-8", "backslashreplace")).hexdigest()
    return folder / f"{digest[:24]}.safetensors"


def _read(path: Path) -> dict[str, Float32[np.ndarray, " D"]]:
    if not path.is_file():
        return {}
    try:
        with open_archive(path) as archive:
            phrases = archive.value("phrases", list)
            vectors = archive.array("vectors", "float32", ("Q", "D"))
        if len(phrases) != len(vectors) or not all(isinstance(phrase, str) for phrase in phrases):
            raise InputError(f"{path}: expected one vector for each phrase")
    except InputError as error:
        warnings.warn(f"cached text vectors are computed again: {error}", SceneWarning, stacklevel=3)
        return {}
    return dict(zip(phrases, vectors, strict=True))


def _write(path: Path, cached: dict[str, Float32[np.ndarray, " D"]]) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_archive(path, {"vectors": np.stack(list(cached.values()))}, {"phrases": list(cached)})
    except (OSError, InputError) as error:
        warnings.warn(
            f"text vectors are not cached: {error} ({CACHE_VARIABLE}={OFF} turns the cache off)",
            SceneWarning,
            stacklevel=3,
        )
