"""Text tables: closed vocabularies of names with embeddings, what makes them, their files, and a cache of vectors.

The cache is one file for each tower and set of templates, since loading a tower takes longer than embedding a word. It
holds nothing that cannot be computed again, so a damaged one is replaced, with a warning.
"""

import difflib
import hashlib
import os
import re
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from gsencoder.core.archive import open_archive, read_npz, write_archive
from gsencoder.core.errors import InputError, SceneWarning, error_prefix
from gsencoder.types import FeatureSpace

KINDS = ("onnx", "transformers")
SLOT = "{}"
"""Where a template takes the phrase."""
NO_TEMPLATES = (SLOT,)
MAX_TEMPLATES = 1000
MAX_PHRASE = 1000
"""Largest number of characters of a phrase: longer than any description of a thing, and quickly tokenized."""


@runtime_checkable
class TextTower(Protocol):
    """Embeds phrases as they are, one at a time: the vector of a phrase does not depend on the others.

    Attributes:
        name: for people; the name of the folder that it was read from.
        identity: kind and digest of all files and settings that its vectors depend on, and never where they lie.
        pooling: how it makes one vector of those of the tokens.
        lower: whether it lower-cases phrases and removes their punctuation before they are tokenized.
        channels: D.
    """

    name: str
    identity: str
    pooling: str
    lower: bool
    channels: int

    def embed(self, phrases: Sequence[str]) -> Float32[np.ndarray, "Q D"]:
        """A unit vector for each phrase; InputError for a phrase that the tower cannot read completely."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class TowerRecord:
    """Which tower made a table of names, as it is stored with the table; see `TextTower`. Each name was put into all
    templates, whose vectors were averaged."""

    kind: str
    name: str
    identity: str
    pooling: str
    templates: tuple[str, ...] = NO_TEMPLATES
    lower: bool = False

    def __post_init__(self) -> None:
        texts = (self.name, self.identity, self.pooling)
        if not all(isinstance(text, str) and 0 < len(text) <= MAX_PHRASE for text in texts) or self.kind not in KINDS:
            raise InputError(f"text tower: expected a kind among {', '.join(KINDS)}, a name, an identity and a pooling")
        check_templates(self.templates)

    def describe(self) -> str:
        """The tower in words, for messages."""
        return f"{self.name!r} ({self.identity})"


def check_templates(templates: Sequence[str]) -> None:
    """Checks that each template has one slot for a phrase."""
    if not 1 <= len(templates) <= MAX_TEMPLATES:
        raise InputError(f"templates: expected 1 to {MAX_TEMPLATES} sentences, got {len(templates)}")
    for template in templates:
        if not isinstance(template, str) or template.count(SLOT) != 1 or len(template) > MAX_PHRASE:
            raise InputError(
                f"templates: expected sentences with one {SLOT} each, such as 'a photo of a {SLOT}', got "
                f"{str(template)[:80]!r}"
            )


def check_phrase(phrase: str) -> str:
    """The phrase with single blanks between its words, which no tokenizer reads otherwise."""
    if len(phrase) > MAX_PHRASE:
        raise InputError(f"query {phrase[:40]!r}…: has {len(phrase):,} characters; expected at most {MAX_PHRASE:,}")
    text = re.sub(r"\s+", " ", phrase).strip()
    if not text:
        raise InputError(f"query {phrase!r}: is empty; expected a word or a phrase")
    if not any(character.isalnum() for character in text):
        raise InputError(f"query {text[:40]!r}: holds no letter and no digit; expected a word or a phrase")
    return text


def check_known(phrase: str, tokens: Sequence[int], unknown: int | None) -> None:
    """Checks that a tokenizer knows all of a phrase, whose tokens are given without special ones at its ends; with a
    part of it unknown another phrase would be embedded."""
    if not tokens or all(token == unknown for token in tokens):
        raise InputError(f"query {phrase[:60]!r}: holds no word that its tokenizer knows")
    if unknown in tokens:
        raise InputError(
            f"query {phrase[:60]!r}: its tokenizer does not know {tokens.count(unknown)} of its {len(tokens)} parts; "
            "leave these out"
        )


def embed_in_templates(
    tower: TextTower, phrases: Sequence[str], templates: Sequence[str]
) -> Float32[np.ndarray, "Q D"]:
    """The mean of a phrase's vectors over templates, of unit length."""
    total = np.zeros((len(phrases), tower.channels))
    for template in templates:
        with error_prefix(f"text tower {tower.name}"):
            vectors = tower.embed([template.replace(SLOT, check_phrase(phrase)) for phrase in phrases])
        if not np.isfinite(vectors).all():
            raise InputError(f"text tower {tower.name}: its vectors are not finite; check the model")
        total += vectors
    return unit(total)


def unit(vectors: np.ndarray) -> Float32[np.ndarray, "Q D"]:
    """Rows of unit length, computed in float64."""
    values = np.asarray(vectors, np.float64)
    norms = np.sqrt((values**2).sum(axis=1, keepdims=True))
    if not (norms > 1e-12).all():
        raise InputError("a vector of a phrase has no length; check the model and the templates")
    return (values / norms).astype(np.float32)


NORM_TOLERANCE = 1e-2
"""Largest difference from 1 of the norm of a stored embedding; float16 rounding is about 1e-3."""
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
        long = next((name for name in self.names if len(name) > MAX_NAME), None)
        if long is not None:
            raise InputError(
                f"TextTable: name {long[:MAX_SHOWN]!r}… has {len(long):,} characters, expected at most {MAX_NAME:,}"
            )
        channels = self.space.channels
        if not self.names or table.shape != (len(self.names), channels) or self.mean.shape != (channels,):
            raise InputError(
                f"TextTable: expected embeddings of {len(self.names)} names and a mean of {channels} channels "
                f"({self.space.name}), got {table.shape} and {self.mean.shape}"
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
        """Whether the encoder of the features was trained on a word; None where that is not known."""
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
        """The embeddings of words; case, blanks, `_`, `-`, a leading article and simple plurals are ignored."""
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


def load_text_table(path: str | Path) -> TextTable:
    """Reads an `.npz` with `names` and `embeddings`, or a `.safetensors` of `save_text_table`.

    The text encoder of an `.npz` is its entry `encoder`, else the name of the file without a trailing "_names".
    """
    file = Path(path)
    if not file.is_file():
        raise InputError(f"{file}: no such file; expected a text table (.npz or .safetensors)")
    return _read_npz(file) if file.suffix == ".npz" else _read_archive(file)


def save_text_table(path: str | Path, table: TextTable, *, dtype: Literal["float32", "float16"] = "float32") -> None:
    """Writes the table as an archive of embeddings and mean, with the names and the space in its header."""
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
    """The record that JSON values hold."""
    if not isinstance(values, dict) or values.keys() != {item.name for item in fields(TowerRecord)}:
        raise InputError(f"expected the record of a text tower, got {str(values)[:60]!r}")
    if not isinstance(values["templates"], list) or not isinstance(values["lower"], bool):
        raise InputError("expected a list of templates, and true or false as lower, in the record of a text tower")
    return TowerRecord(**{**values, "templates": tuple(values["templates"])})


def trained_from_json(values: Any) -> tuple[str, ...]:
    """The names trained on that JSON values hold."""
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise InputError(f"expected a list of the names trained on, got {str(values)[:60]!r}")
    return tuple(values)


def _read_archive(file: Path) -> TextTable:
    with open_archive(file) as archive:
        dtype = archive.value("dtype", str)
        if dtype not in ("float32", "float16"):
            raise InputError(f"{file}: expected embeddings of float32 or float16, got {dtype[:20]!r}")
        embeddings = archive.array("embeddings", dtype, ("C", "D"))
        names, space = archive.value("names", list), archive.value("space", dict)
        texts = all(isinstance(name, str) for name in names) and {"name", "channels"} <= set(space)
        if not texts or not set(space) <= {item.name for item in fields(FeatureSpace)}:
            raise InputError(f"{file}: expected names, and a space with a name and channels")
        return TextTable(
            names=tuple(names),
            embeddings=unrounded(embeddings.astype(np.float32)) if dtype == "float16" else embeddings,
            space=FeatureSpace(**space),
            mean=archive.array("mean", "float32", ("D",)),
            tower=tower_from_json(archive.value("tower", dict)) if "tower" in archive else None,
            trained=trained_from_json(archive.value("trained", list)) if "trained" in archive else None,
        )


def _read_npz(file: Path) -> TextTable:
    expected = {"names": ("U", 1), "embeddings": ("f", 2)}
    arrays = read_npz(file, expected, {"encoder": ("U", 0)}, max_text=MAX_NAME)
    made_by = str(arrays.get("encoder", "")) or file.stem.removesuffix("_names")
    try:
        return make_text_table([str(name) for name in arrays["names"]], arrays["embeddings"], made_by)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error


@runtime_checkable
class TextEncoder(Protocol):
    """Encodes words as vectors of a feature space: a table, or an `OpenVocabulary`."""

    @property
    def space(self) -> FeatureSpace:
        """Its `text_encoder` is the name of this encoder."""
        ...

    @property
    def mean(self) -> Float32[np.ndarray, " D"]:
        """The mean of text vectors, which centered cosines subtract from words."""
        ...

    def encode(self, words: Sequence[str]) -> Float32[np.ndarray, "Q D"]:
        """A unit vector for each word; InputError for an unknown word."""
        ...


def check_space(features: FeatureSpace, text: FeatureSpace) -> None:
    """Checks that words and features have the same text encoder."""
    if not features.text_encoder:
        raise InputError(
            f"features of space ({features.describe()}) cannot be queried with words: it has no text encoder; "
            "fuse with a teacher that has one"
        )
    if features.text_encoder != text.text_encoder or features.channels != text.channels:
        raise InputError(
            f"features of space ({features.describe()}) cannot be compared with words of space ({text.describe()}): "
            f"use the text encoder {features.text_encoder!r}"
        )


CACHE_VARIABLE = "GSENCODER_CACHE"
"""A folder; "off" = no cache; not set = gsencoder in the user's folder of caches."""
OFF = "off"
MAX_PHRASES = 20_000
"""A file that would grow beyond starts again."""


def cache_folder() -> Path | None:
    """The folder of cached vectors, or None where caching is off."""
    folder = os.environ.get(CACHE_VARIABLE, "")
    if folder == OFF:
        return None
    if folder:
        return Path(folder) / "text"
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "gsencoder" / "text"


def cached_vectors(
    identity: str,
    templates: Sequence[str],
    phrases: Sequence[str],
    compute: Callable[[list[str]], Float32[np.ndarray, "missing D"]],
) -> Float32[np.ndarray, "Q D"]:
    """The vectors of phrases, from the cache of a tower and its templates; `compute` embeds those that it lacks."""
    folder = cache_folder()
    digest = hashlib.sha256(repr((identity, tuple(templates))).encode("utf-8", "backslashreplace")).hexdigest()
    path = None if folder is None else folder / f"{digest[:24]}.safetensors"
    cached = _read(path) if path is not None else {}
    missing = list(dict.fromkeys(phrase for phrase in phrases if phrase not in cached))
    if missing:
        computed = dict(zip(missing, compute(missing), strict=True))
        if path is not None:
            _write(path, computed if len(cached) + len(computed) > MAX_PHRASES else cached | computed)
        cached = cached | computed
    return np.stack([cached[phrase] for phrase in phrases])


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


REFERENCE_NOUNS = tuple(Path(__file__).with_name("nouns.txt").read_text(encoding="utf-8").splitlines())
"""Everyday nouns; the mean of the vectors of these alone is that of a tower."""


WORDS_FILE = "words.safetensors"
"""The text table of the features' space, where there is one."""
TEACHER_NAME = r"[A-Za-z0-9_][A-Za-z0-9_-]*"
"""Form of the names of teachers, which are parts of names of files."""


def file_of_teacher(file: str, teacher: str | None) -> str:
    """The name of a file for one of several teachers, such as `features.labels.safetensors`; None = the only one."""
    stem, dot, suffix = file.partition(".")
    return file if teacher is None else f"{stem}.{teacher}{dot}{suffix}"


def teachers_in(folder: Path, file: str) -> list[str]:
    """The teachers of which a folder has such files."""
    stem, dot, suffix = file.partition(".")
    form = re.compile(re.escape(stem) + rf"\.({TEACHER_NAME})" + re.escape(dot + suffix))
    return sorted(match[1] for path in folder.iterdir() if (match := form.fullmatch(path.name)))


def save_tables(
    folder: Path,
    tables: Mapping[str, TextTable],
    teachers: Iterable[str],
    *,
    dtype: Literal["float32", "float16"] = "float32",
) -> None:
    """Writes text tables, by the teacher in whose space they are, next to features or weights. `teachers` are all of
    the features or the encoder, with tables or not; a single one is not named in files."""
    single = len(list(teachers)) == 1
    for teacher, table in tables.items():
        save_text_table(folder / file_of_teacher(WORDS_FILE, None if single else teacher), table, dtype=dtype)


def load_tables(folder: Path, teachers: Iterable[str]) -> dict[str, TextTable]:
    """The text tables of a folder by teacher; teachers without a file are left out."""
    names = list(teachers)
    paths = {name: folder / file_of_teacher(WORDS_FILE, name if len(names) > 1 else None) for name in names}
    return {name: load_text_table(path) for name, path in paths.items() if path.is_file()}


def table_path(folder: Path, text_encoder: str) -> Path | None:
    """The text table in a folder of features that this text encoder made; None where there is none, and an InputError
    where there are only those of other encoders."""
    if (folder / WORDS_FILE).is_file():
        return folder / WORDS_FILE
    if not text_encoder:
        return None
    paths = [folder / file_of_teacher(WORDS_FILE, teacher) for teacher in teachers_in(folder, WORDS_FILE)]
    encoders = {path: load_text_table(path).space.text_encoder for path in paths}
    fitting = [path for path, encoder in encoders.items() if encoder == text_encoder]
    if paths and not fitting:
        raise InputError(
            f"{folder}: no {file_of_teacher(WORDS_FILE, 'TEACHER')} holds words of {text_encoder}, the text encoder "
            f"of these features (there are words of {', '.join(sorted(set(encoders.values())))}): the file was lost; "
            "give words= or text=, or name other features with space="
        )
    return fitting[0] if fitting else None
