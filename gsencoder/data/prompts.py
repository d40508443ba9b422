"""Prompts on disk: the words and pictures for a VLM, prepared once and read many times.

A folder has `prompts.jsonl`, one line a prompt, its pictures, encoded as they are sent, and tokens. These
files are called by the digest of what is in them, so that questions about the same thing share theirs.
"""

import io
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np
from jaxtyping import Float16, UInt8
from PIL import Image

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError, readable
from gsencoder.core.files import MODEL_BYTES, read_foreign, with_checksum, without_checksum, write_bytes

PROMPTS_FILE, PICTURES_FOLDER, TOKENS_FOLDER = "prompts.jsonl", "pictures", "tokens"


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredPrompt:
    """A prompt in a store."""

    text: str  # the words
    pictures: tuple[str, ...]  # names of the files of its pictures, in their order
    tokens: str = ""  # name of the file of rendered features, one set of tokens a picture; empty = none
    space: str = ""  # of these features, for people and to tell one from another


class PromptStore:
    """A folder of prompts by key. Each is on the disk when `add` returns: an interrupted preparation goes on."""

    def __init__(self, folder: Path) -> None:
        """Takes an existing folder, empty or filled by a store."""
        self.folder = folder
        self.prompts: dict[str, StoredPrompt] = {}
        self._end = 0
        path = folder / PROMPTS_FILE
        if not path.is_file():
            return
        with readable(path):
            # What follows the last line break was cut off, and the next prompt is written over it.
            lines = read_foreign(path, MODEL_BYTES).split(b"\n")[:-1]
        self._end = sum(len(line) + 1 for line in lines)
        for number, line in enumerate(lines, start=1):
            try:
                row = without_checksum(json.loads(line))
                key, pictures = row.pop("key"), tuple(row.pop("pictures"))
                names = (*pictures, row["tokens"]) if row["tokens"] else pictures
                if not pictures or any(Path(name).name != name or name == ".." for name in names):
                    raise ValueError(row)
                self.prompts[key] = StoredPrompt(pictures=pictures, **row)
            except (ValueError, KeyError, TypeError, RecursionError) as error:
                raise InputError(
                    f"{path}: line {number} is no prompt, or damaged; remove the folder to make it again"
                ) from error

    def add(
        self,
        key: str,
        text: str,
        pictures: Sequence[bytes],
        tokens: Float16[np.ndarray, "V P D"] | None = None,
        space: str = "",
    ) -> StoredPrompt:
        """Writes a prompt, with rendered features of its pictures on the grid of a vision tower as tokens."""
        names = tuple(self._write_picture(each) for each in pictures)
        file = "" if tokens is None else self._write_tokens(tokens)
        prompt = StoredPrompt(text=text, pictures=names, tokens=file, space=space)
        line = json.dumps(with_checksum({"key": key, **asdict(prompt)}), ensure_ascii=False).encode() + b"\n"
        path = self.folder / PROMPTS_FILE
        try:
            path.touch()
            with path.open("r+b") as stream:
                stream.seek(self._end)
                stream.truncate()
                stream.write(line)
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise InputError(f"{path}: cannot write: {error.strerror or error}") from error
        self.prompts[key], self._end = prompt, self._end + len(line)
        return prompt

    def _write_picture(self, data: bytes) -> str:
        name = f"{sha256(data).hexdigest()[:32]}.{'png' if data.startswith(bytes([137]) + b'PNG') else 'jpg'}"
        path = self.folder / PICTURES_FOLDER / name
        path.parent.mkdir(exist_ok=True)
        if not path.is_file():
            write_bytes(path, data)
        return name

    def _write_tokens(self, tokens: Float16[np.ndarray, "V P D"]) -> str:
        name = f"{sha256(repr(tokens.shape).encode() + tokens.tobytes()).hexdigest()[:32]}.safetensors"
        path = self.folder / TOKENS_FOLDER / name
        path.parent.mkdir(exist_ok=True)
        if not path.is_file():
            write_archive(path, {"tokens": tokens}, {})
        return name

    def picture(self, name: str) -> UInt8[np.ndarray, "H W 3"]:
        """A picture as a model gets it."""
        path = self.folder / PICTURES_FOLDER / name
        try:
            data = read_foreign(path)
            if sha256(data).hexdigest()[:32] != path.stem:
                raise InputError(f"{path}: is damaged; remove {self.folder} to prepare it again")
            return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
        except OSError as error:
            raise InputError(f"{path}: cannot be read; remove {self.folder} to prepare it again") from error

    def tokens(self, name: str) -> Float16[np.ndarray, "V P D"]:
        """Rendered features of the pictures of a prompt."""
        path = self.folder / TOKENS_FOLDER / name
        with open_archive(path) as file:
            return file.array("tokens", "float16", file.shape("tokens", "float16", 3))
