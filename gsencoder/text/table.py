"""Text tables: closed vocabularies of names with their embeddings, and their files."""

import difflib
import json
import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32

from gsencoder.core.archive import open_archive, read_npz, warn_without_checksums, write_archive
from gsencoder.core.errors import InputError, about, readable
from gsencoder.core.files import open_foreign
from gsencoder.text.towers import TowerRecord
from gsencoder.types import FeatureSpace

NORM_TOLERANCE = 1e-2
"""Largest difference from 1 of the norm of a stored embedding; float16 rounding is about 1e-3."""
FORMAT_1 = "gsencoder text table 1"
MAX_SHOWN = 80
"""Number of characters of a word that an error repeats."""
MAX_NAME = 1000
"""Largest number of characters of a name: longer than any word or caption, and short enough for comparisons."""


def normalize(word: str) -> str:
    """The form in which words are compared: NFKC, lower case, single blanks for blanks, `_` and `-`, no article."""
    text = " ".join(re.split(r"[\s_\-]+", unicodedata.normalize("NFKC", word).casefold())).strip()
    return re.sub(r"^(?:a|an|the) (?=.)", "", text)


def _singulars_and_plurals(key: str) -> list[str]:
    """Simple English singulars of a word, then its plurals; wrong forms do no harm, since no table has them."""
    forms = []
    for ending, singular in (("ies", "y"), ("ves", "f"), ("ves", "fe"), ("es", ""), ("s", "")):
        if key.endswith(ending) and len(key) > len(ending) + 1 and not key.endswith("ss"):
            forms.append(key[: -len(ending)] + singular)
    forms += [key + "s", key + "es"]
    if key.endswith("y"):
        forms.append(key[:-1] + "ies")
    if key.endswith("fe"):
        forms.append(key[:-2] + "ves")
    if key.endswith("f"):
        forms.append(key[:-1] + "ves")
    return forms


@dataclass(frozen=True, kw_only=True, eq=False)
class TextTable:
    """A closed vocabulary: names and their embeddings.

    Attributes:
        names: the words, unique after `normalize`.
        embeddings: a unit vector for each name.
        space: of the vectors; its `text_encoder` is the name of the encoder that made them.
        mean: the mean of the embeddings. Text and image features of a joint model have different means, so each side
            is centered by its own.
        tower: which text tower made the embeddings, where one did that can be asked for other phrases.
        trained: the names that the encoder of the features was trained on; None where nothing states them.
    """

    names: tuple[str, ...]
    embeddings: Float32[np.ndarray, "C D"]
    space: FeatureSpace
    mean: Float32[np.ndarray, " D"]
    tower: TowerRecord | None = None
    trained: tuple[str, ...] | None = None
    _row_of: dict[str, int] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        table = self.embeddings
        long = next((row for row, name in enumerate(self.names) if len(name) > MAX_NAME), None)
        if long is not None:
            raise InputError(
                f"TextTable: name {self.names[long][:MAX_SHOWN]!r}… in row {long} has {len(self.names[long]):,} "
                f"characters, expected at most {MAX_NAME:,}"
            )
        if not self.names or table.ndim != 2 or len(table) != len(self.names):
            raise InputError(
                f"TextTable: expected one embedding for each name, got {len(self.names)} names and {table.shape}"
            )
        if table.shape[1] != self.space.channels or self.mean.shape != (self.space.channels,):
            raise InputError(
                f"TextTable: expected {self.space.channels} channels ({self.space.name}), got embeddings of "
                f"{table.shape[1]} and a mean of {self.mean.shape}"
            )
        if self.tower is not None and self.tower.identity != self.space.text_encoder:
            raise InputError(
                f"TextTable: expected the tower {self.space.text_encoder!r} of its space, got {self.tower.identity!r}"
            )
        norms = np.sqrt((table.astype(np.float64) ** 2).sum(axis=1))
        bad = np.flatnonzero(~(np.abs(norms - 1) <= NORM_TOLERANCE))
        if bad.size or not np.isfinite(self.mean).all():
            first = "the mean is not finite"
            if bad.size:
                first = f"{self.names[bad[0]][:MAX_SHOWN]!r} has norm {norms[bad[0]]:.4g}"
            raise InputError(f"TextTable: expected finite unit vectors, {first} ({bad.size} bad of {len(norms)} rows)")
        for row, name in enumerate(self.names):
            key = normalize(name)
            if not key or key in self._row_of:
                wrong = "repeated" if key else "empty"
                raise InputError(f"TextTable: name {name[:MAX_SHOWN]!r} in row {row} is {wrong}")
            self._row_of[key] = row
        missing = sorted(set(self.trained or ()) - set(self.names))
        if missing:
            raise InputError(
                f"TextTable: expected the names trained on among its {len(self)} names, got {missing[0][:MAX_SHOWN]!r}"
            )

    def __len__(self) -> int:
        return len(self.names)

    def find(self, word: str) -> int | None:
        """The row of a word, else of its singular or plural, or None."""
        key = normalize(word)
        return next((self._row_of[form] for form in (key, *_singulars_and_plurals(key)) if form in self._row_of), None)

    def is_trained(self, word: str) -> bool | None:
        """Whether the encoder of the features was trained on a word; None where that is not stated."""
        if self.trained is None:
            return None
        row = self.find(word)
        return row is not None and self.names[row] in self.trained

    def trained_on(self, names: Iterable[str]) -> "TextTable":
        """The table, stating that the encoder of the features was trained on those of these names that it has."""
        rows = {row: None for name in names if (row := self.find(name)) is not None}
        return replace(self, trained=tuple(self.names[row] for row in rows))

    def near(self, word: str, count: int = 6) -> tuple[str, ...]:
        """Suggestions for an unknown word: names that share a word with it, and names that are spelled similarly."""
        row_of, key = self._row_of, normalize(word)
        tokens = {form for token in key.split() for form in (token, *_singulars_and_plurals(token))}
        sharing = [name for name in row_of if tokens & set(name.split())]
        sharing.sort(key=lambda name: (-difflib.SequenceMatcher(None, key, name).ratio(), name))
        alike = difflib.get_close_matches(key, list(row_of), n=count, cutoff=0.6)
        near_names = dict.fromkeys([*alike[:1], *sharing, *alike])
        return tuple(self.names[row_of[name]] for name in list(near_names)[:count])

    def encode(self, words: Sequence[str]) -> Float32[np.ndarray, "Q D"]:
        """The embeddings of words; case, blanks, `_`, `-`, a leading article and simple plurals are ignored.

        Raises:
            InputError: words that are not in the table; the message suggests similar names.
        """
        rows = [self.find(word) for word in words]
        unknown = [word for word, row in zip(words, rows, strict=True) if row is None]
        if unknown:
            parts = [f"{word[:MAX_SHOWN]!r}{_did_you_mean(self.near(word[:MAX_NAME]))}" for word in unknown[:3]]
            more = f" and {len(unknown) - 3} more" if len(unknown) > 3 else ""
            space = self.space.name[:MAX_SHOWN]
            advice = "; phrases need a sentence encoder, as in fuse teacher=mosaic text=minilm"
            phrases = advice if any(" " in word.strip() for word in unknown) else ""
            raise InputError(f"not among the {len(self)} words of {space}: {'; '.join(parts)}{more}{phrases}")
        return self.embeddings[np.array(rows, np.int64)]


def _did_you_mean(names: Sequence[str]) -> str:
    return f" (near: {', '.join(name[:MAX_SHOWN] for name in names)})" if names else " (no name is near)"


def make_text_table(names: Iterable[str], embeddings: np.ndarray, encoder: str) -> TextTable:
    """Makes a table from names and their unit vectors of any float type, which the text encoder `encoder` made.

    Rows are normalized in float32, which removes the rounding of a float16 file.

    Raises:
        InputError: repeated or empty names, rows that are not finite unit vectors, sizes that differ.
    """
    table = np.ascontiguousarray(embeddings, dtype=np.float32)
    if table.ndim != 2 or 0 in table.shape:
        raise InputError(f"text table of {encoder}: expected embeddings [names, channels], got shape {table.shape}")
    table = unrounded(table)
    space = FeatureSpace(name=encoder, channels=table.shape[1], text_encoder=encoder)
    mean = table.mean(axis=0, dtype=np.float64).astype(np.float32)
    return TextTable(names=tuple(names), embeddings=table, space=space, mean=mean)


def unrounded(table: Float32[np.ndarray, "C D"]) -> Float32[np.ndarray, "C D"]:
    """Normalizes rounded unit vectors; rows far from unit length are not changed, so that TextTable refuses them."""
    norms = np.linalg.norm(table, axis=1, keepdims=True)
    rounded = np.abs(norms - 1) <= NORM_TOLERANCE
    return np.asarray(np.where(rounded, table / np.where(rounded, norms, 1), table))


def load_text_table(path: str | Path, *, encoder: str = "") -> TextTable:
    """Reads an `.npz` with `names` and `embeddings`, or a `.safetensors` of `save_text_table`.

    Args:
        path: the file.
        encoder: name of the text encoder. If empty, it is the entry `encoder` of the file, else the name of the file
            without a trailing "_names".

    Raises:
        InputError: missing, damaged or hostile, or not a text table.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError(f"{file}: no such file; expected a text table (.npz or .safetensors)")
    with readable(file), open_foreign(file) as stream:
        zipped = stream.read(2) == b"PK"
    if zipped or file.suffix == ".npz":
        return _read_npz(file, encoder)
    return _read_version_1(file) if _is_version_1(file) else _read_archive(file)


def save_text_table(path: str | Path, table: TextTable, *, dtype: Literal["float32", "float16"] = "float32") -> None:
    """Writes the table as an archive of embeddings and mean, with the names and the space in its header.

    Args:
        path: the file.
        table: to store.
        dtype: of the embeddings; float16 halves the file.

    Raises:
        InputError: the file cannot be written; an earlier file stays.
    """
    space = {item.name: getattr(table.space, item.name) for item in fields(table.space)}
    arrays = {"embeddings": table.embeddings.astype(dtype), "mean": table.mean}
    header: dict[str, Any] = {"names": list(table.names), "space": space, "dtype": dtype}
    if table.tower is not None:
        header["tower"] = tower_to_json(table.tower)
    if table.trained is not None:
        header["trained"] = list(table.trained)
    write_archive(Path(path), arrays, header)


def tower_to_json(tower: TowerRecord) -> dict[str, Any]:
    """The record of a tower as JSON values."""
    return {**asdict(tower), "templates": list(tower.templates)}


def tower_from_json(values: Any) -> TowerRecord:
    """The record that JSON values hold.

    Raises:
        InputError: they hold none.
    """
    if not isinstance(values, dict) or {"lower", *values} != {item.name for item in fields(TowerRecord)}:
        raise InputError(f"expected the record of a text tower, got {str(values)[:60]!r}")
    if not isinstance(values["templates"], list):
        raise InputError("expected a list of templates in the record of a text tower")
    # Records of earlier versions do not state it.
    values = {"lower": False, **values}
    if not isinstance(values["lower"], bool):
        raise InputError("expected true or false as lower in the record of a text tower")
    return TowerRecord(**{**values, "templates": tuple(values["templates"])})


def trained_from_json(values: Any) -> tuple[str, ...]:
    """The names trained on that JSON values hold.

    Raises:
        InputError: they hold none.
    """
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise InputError(f"expected a list of the names trained on, got {str(values)[:60]!r}")
    return tuple(values)


def _read_archive(file: Path) -> TextTable:
    with open_archive(file) as archive:
        dtype = archive.value("dtype", str)
        if dtype not in ("float32", "float16"):
            raise InputError(f"{file}: expected embeddings of float32 or float16, got {dtype[:20]!r}")
        arrays = {
            "embeddings": archive.array("embeddings", dtype, ("C", "D")),
            "mean": archive.array("mean", "float32", ("D",)),
        }
        tower = tower_from_json(archive.value("tower", dict)) if "tower" in archive else None
        trained = trained_from_json(archive.value("trained", list)) if "trained" in archive else None
        return _table(file, archive.value("names", list), archive.value("space", dict), arrays, tower, trained)


def _is_version_1(file: Path) -> bool:
    """Whether a safetensors file is a text table of the first version, which has another format and no checksums."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(file, framework="np") as stored:
            return (stored.metadata() or {}).get("format") == FORMAT_1
    except (OSError, SafetensorError, ValueError) as error:
        raise InputError(f"{file}: cannot be read as a text table: {_one_line(error)}") from error


def _read_version_1(file: Path) -> TextTable:
    from safetensors import SafetensorError, safe_open

    warn_without_checksums(file)
    try:
        with safe_open(file, framework="np") as stored:
            arrays = {name: stored.get_tensor(name) for name in ("embeddings", "mean")}
            header = json.loads(stored.metadata()["table"])
        names, space = header["names"], header["space"]
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{file}: cannot be read as a text table: {_one_line(error)}") from error
    return _table(file, names, space, arrays)


def _table(
    file: Path,
    names: Any,
    space: Any,
    arrays: dict[str, np.ndarray],
    tower: TowerRecord | None = None,
    trained: tuple[str, ...] | None = None,
) -> TextTable:
    """A table of what a file holds.

    Raises:
        InputError: other types, shapes or values than a table has.
    """
    shapes = arrays["embeddings"].ndim == 2 and arrays["mean"].ndim == 1
    types = arrays["embeddings"].dtype in (np.float32, np.float16) and arrays["mean"].dtype == np.float32
    texts = isinstance(names, list) and all(isinstance(name, str) for name in names)
    texts &= isinstance(space, dict) and set(space) <= {item.name for item in fields(FeatureSpace)}
    texts = texts and all(isinstance(value, int if key == "channels" else str) for key, value in space.items())
    if not texts or not {"name", "channels"} <= set(space) or not shapes or not types:
        raise InputError(
            f"{file}: expected embeddings [C, D] of float32 or float16, a float32 mean [D], names and a space of text"
        )
    if arrays["embeddings"].dtype == np.float16:
        arrays["embeddings"] = unrounded(arrays["embeddings"].astype(np.float32))
    with about(file):
        return TextTable(names=tuple(names), space=FeatureSpace(**space), tower=tower, trained=trained, **arrays)


def _read_npz(file: Path, encoder: str) -> TextTable:
    expected = {"names": ("U", 1), "embeddings": ("f", 2)}
    arrays = read_npz(file, expected, {"encoder": ("U", 0)}, max_text=MAX_NAME)
    made_by = encoder or str(arrays.get("encoder", "")) or file.stem.removesuffix("_names")
    try:
        return make_text_table([str(name) for name in arrays["names"]], arrays["embeddings"], made_by)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error


def _one_line(error: BaseException) -> str:
    return (" ".join(str(error).split()) or type(error).__name__)[:200]
