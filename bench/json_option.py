"""The `--json FILE` option of bench scripts: the figures that they print, for `bench/run.py` and other programs."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsencoder.core.files import write_json


def add_json_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures as JSON too")


def write_figures(file: Path | None, figures: Mapping[str, Any]) -> None:
    """Writes figures in full precision where --json names a file; values that are not finite become null."""
    if file is not None:
        write_json(file, figures)
