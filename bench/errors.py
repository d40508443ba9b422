"""What bench scripts share for wrong arguments and wrong input: one line on standard error, and exit code 2."""

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import CalledProcessError

from gsencoder.core.errors import InputError, listed, one_line


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Ends the script with exit code 2 where the block meets wrong input, or a command that it runs fails.

    A command that ends with code 2 has printed the line itself; of any other end a line is printed here.
    """
    try:
        yield
    except InputError as error:
        print(f"error: {one_line(str(error))}", file=sys.stderr)
        sys.exit(2)
    except CalledProcessError as error:
        end = f"exit code {error.returncode}" if error.returncode >= 0 else f"signal {-error.returncode}"
        if error.returncode != 2:
            print(f"error: ended with {end}: {one_line(' '.join(error.cmd))}", file=sys.stderr)
        sys.exit(2)


def positive(text: str) -> int:
    """The type of an argument that is a whole number from 1."""
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1, got {text!r}")
    return number


def existing_folder(text: str) -> Path:
    """The type of an argument that is a folder to read."""
    path = Path(text)
    if not path.is_dir():
        raise argparse.ArgumentTypeError(f"{text}: " + ("not a folder" if path.exists() else "no such folder"))
    return path


def output_folder(text: str) -> Path:
    """The type of an argument that is a folder to write, which may be missing."""
    path = Path(text)
    if path.exists() and not path.is_dir():
        raise argparse.ArgumentTypeError(f"{text}: a file; expected a folder, or a new name")
    return path


def comma_separated(text: str) -> list[str]:
    """The type of an argument that lists words, separated by commas."""
    words = text.split(",")
    if not all(words):
        raise argparse.ArgumentTypeError(f"expected words separated by commas, got an empty one in {text!r}")
    return words


def matching_names(parser: argparse.ArgumentParser, folder: Path, pattern: str) -> list[Path]:
    """What is in a folder and has a name of the pattern --names, in order; an error of the parser where nothing has."""
    try:
        paths = sorted(folder.glob(pattern))
    except (ValueError, NotImplementedError) as error:
        parser.error(f"--names {pattern!r}: not a pattern of names ({error}); expected one such as 'train_0*'")
    if not paths:
        present = sorted(path.name for path in folder.iterdir())
        parser.error(f"--names {pattern!r}: matches nothing in {folder} ({listed(present) or 'empty'})")
    return paths
