"""Text tables beside features and encoders: `words.safetensors`, or one file for each of several teachers."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

from gsencoder.core.errors import InputError
from gsencoder.fusion.store.folder import WORDS_FILE, file_of_teacher, teachers_in
from gsencoder.text.table import TextTable, load_text_table, save_text_table


def save_tables(
    folder: Path,
    tables: Mapping[str, TextTable],
    teachers: Iterable[str],
    *,
    dtype: Literal["float32", "float16"] = "float32",
) -> None:
    """Writes text tables beside features or weights.

    Args:
        folder: an existing folder.
        tables: by the teacher in whose space they are.
        teachers: all teachers of the features or the encoder, with tables or not; a single one is not named in files.
        dtype: of the embeddings.

    Raises:
        InputError: a file cannot be written.
    """
    single = len(list(teachers)) == 1
    for teacher, table in tables.items():
        save_text_table(folder / file_of_teacher(WORDS_FILE, None if single else teacher), table, dtype=dtype)


def load_tables(folder: Path, teachers: Iterable[str]) -> dict[str, TextTable]:
    """The text tables of a folder by teacher; teachers without a file are left out.

    Raises:
        InputError: a file is damaged.
    """
    names = list(teachers)
    paths = {name: folder / file_of_teacher(WORDS_FILE, name if len(names) > 1 else None) for name in names}
    return {name: load_text_table(path) for name, path in paths.items() if path.is_file()}


def table_path(folder: Path, text_encoder: str) -> Path | None:
    """The file in a folder of features whose words lead into the features of one space; None where there is none.

    Args:
        folder: of features.
        text_encoder: of the space of these features.

    Raises:
        InputError: a file is damaged, or there are files, but of other spaces.
    """
    if (folder / WORDS_FILE).is_file():
        return folder / WORDS_FILE
    if not text_encoder:
        return None
    paths = [folder / file_of_teacher(WORDS_FILE, teacher) for teacher in teachers_in(folder, WORDS_FILE)]
    encoders = {path: load_text_table(path).space.text_encoder for path in paths}
    fitting = [path for path, encoder in encoders.items() if encoder == text_encoder]
    if paths and not fitting:
        raise InputError(
            f"{folder}: no {file_of_teacher(WORDS_FILE, 'TEACHER')} holds words of {text_encoder}, which lead into "
            f"these features (there are words of {', '.join(sorted(set(encoders.values())))}): the file was lost; give "
            "words= or text=, or name other features with space="
        )
    return fitting[0] if fitting else None
