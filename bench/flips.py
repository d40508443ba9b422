"""Bits flipped in files of real size: how many change what is read without an error.

    python bench/flips.py FEATURES|PACKAGE|WEIGHTS… [--flips 60] [--seed 0]

Each file of a folder is flipped in turn and read as commands read it: folders of features and packages with all that is
in them, encoders, tables of words. `tests/test_flipped_bits.py` does the same for small files of every kind.
"""

import argparse
import hashlib
import random
import shutil
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.core.errors import InputError
from gsencoder.fusion.folder import FEATURES_FILE, load_features
from gsencoder.models.encoder import load_weights
from gsencoder.models.output_space import WEIGHTS_FILE
from gsencoder.text.table import WORDS_FILE, load_text_table


def digest(value: Any) -> str:
    """Of all arrays and values in what a reader gives."""
    if isinstance(value, np.ndarray):
        return hashlib.sha256(np.ascontiguousarray(value).tobytes() + str(value.shape).encode()).hexdigest()
    if hasattr(value, "numpy"):
        return digest(value.numpy())
    if isinstance(value, dict):
        return digest([[key, value[key]] for key in sorted(value)])
    if isinstance(value, (list, tuple)):
        return hashlib.sha256("".join(map(digest, value)).encode()).hexdigest()
    if hasattr(value, "__dataclass_fields__"):
        return digest([getattr(value, name) for name in value.__dataclass_fields__ if name != "folder"])
    return hashlib.sha256(repr(value).encode()).hexdigest()


def reader_of(file: Path) -> Callable[[], Any]:
    if file.name == WORDS_FILE:
        return lambda: load_text_table(file)
    if file.name == WEIGHTS_FILE:
        return lambda: (lambda made: (made[0].state_dict(), made[1], made[2]))(load_weights(file))
    return lambda: load_features(file.parent)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--flips", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    add_json_option(parser)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    rng, kinds = random.Random(given.seed), {".safetensors", ".gsf", ".ply"}
    files = all_silent = 0
    for folder in given.folders:
        with tempfile.TemporaryDirectory() as name:
            copy = Path(shutil.copytree(folder, Path(name) / "copy"))
            features = (copy / FEATURES_FILE).is_file() or (copy / "features.gsf").is_file()
            for file in sorted(path for path in copy.iterdir() if path.suffix in kinds):
                if file.suffix == ".ply" and not features:
                    continue
                read = reader_of(file)
                expected, refused, same = digest(read()), 0, 0
                for _ in range(given.flips):
                    byte, bit = rng.randrange(file.stat().st_size), 1 << rng.randrange(8)
                    for _turn in ("flip", "and back"):
                        with file.open("r+b") as stream:
                            stream.seek(byte)
                            old = stream.read(1)[0]
                            stream.seek(byte)
                            stream.write(bytes([old ^ bit]))
                        if _turn == "flip":
                            try:
                                same += digest(read()) == expected
                            except InputError:
                                refused += 1
                silent = given.flips - refused - same
                files, all_silent = files + 1, all_silent + silent
                size = file.stat().st_size / 2**20
                print(
                    f"{folder.name}/{file.name} ({size:.1f} MiB): {refused} refused, {same} the same, {silent} silent"
                )
    write_figures(given.json, {"files": files, "silent": all_silent})


if __name__ == "__main__":
    main()
