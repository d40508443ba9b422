"""Captions of regions: a JSON file beside label images, or the names of the scene's objects."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError
from gsencoder.data.readers.transforms_json import read_json
from gsencoder.fusion.teachers.regions.masks import view_stem
from gsencoder.text.table import MAX_NAME, MAX_SHOWN
from gsencoder.types import SceneObject

FORMS = '{"label": "caption"} for all views, or {"view": {"label": "caption"}}'


@dataclass(frozen=True, slots=True, kw_only=True)
class Captions:
    """Captions by label, for all views or view by view.

    Attributes:
        shared: for all views; None where each view has its own.
        by_view: by the view's whole name without its ending.
        source: for messages.
    """

    shared: Mapping[int, str] | None = None
    by_view: Mapping[str, Mapping[int, str]] | None = None
    source: str = ""

    def of_view(self, name: str) -> Mapping[int, str]:
        """The captions of the labels of a view."""
        if self.shared is not None:
            return self.shared
        assert self.by_view is not None
        return self.by_view.get(str(view_stem(name)), {})


def captions_of_objects(objects: Sequence[SceneObject]) -> Captions:
    """The names of a scene's objects as captions of its instance maps.

    Raises:
        InputError: no object has a name.
    """
    names = {item.id: item.name for item in objects if item.name is not None}
    if not names:
        raise InputError(
            "teacher regions: masks=instances: no object of the scene has a name (objects.json beside its views); give "
            "a JSON file of captions, teacher.captions="
        )
    return Captions(shared=names, source="objects.json")


def read_captions(path: Path, view_names: Sequence[str]) -> Captions:
    """Captions of a JSON file.

    Args:
        path: the file: {"label": "caption"} for all views, or {"view": {"label": "caption"}} with views by their names,
            with or without the ending, or by its last part where that is unique.
        view_names: of the scene.

    Raises:
        InputError: another form, labels that are no numbers from 1, captions that are not text, or other views than
            those of the scene.
    """
    data = read_json(path, unique_keys=True)
    if not isinstance(data, dict) or not data:
        got = "an empty object" if isinstance(data, dict) else type(data).__name__
        raise InputError(f"{path}: expected captions of regions, {FORMS}; got {got}")
    nested = {isinstance(value, dict) for value in data.values()}
    if nested == {False}:
        return Captions(shared=_labels(data, path, ""), source=str(path))
    if nested != {True}:
        odd = next(key for key, value in data.items() if not isinstance(value, dict))
        raise InputError(f"{path}: expected captions of regions, {FORMS}; got a mixture of both, see {odd[:40]!r}")
    by_view = {str(view_stem(view)): _labels(data[view], path, f" view {view[:40]!r}:") for view in data}
    if len(by_view) < len(data):
        raise InputError(f"{path}: a view is listed twice, with and without the ending of its picture")
    stems = [view_stem(name) for name in view_names]
    ends = [stem.name for stem in stems]
    double = sorted({end for end in ends if ends.count(end) > 1 and end in by_view} - {str(stem) for stem in stems})
    if double:
        raise InputError(f"{path}: {double[0]!r} stands for {ends.count(double[0])} views; write their whole names")
    unique = {stem.name: str(stem) for stem in stems if ends.count(stem.name) == 1}
    both = sorted(
        end for end, full_name in unique.items() if end != full_name and end in by_view and full_name in by_view
    )
    if both:
        raise InputError(f"{path}: {both[0]!r} and {unique[both[0]]!r} are one view, which is listed twice")
    by_view = {unique.get(view, view): captions for view, captions in by_view.items()}
    if not any(str(stem) in by_view for stem in stems):
        raise InputError(
            f"{path}: none of its {len(by_view)} views is one of the scene, first {next(iter(data))[:40]!r}; the "
            f"scene's are {view_names[0]!r}, …"
        )
    return Captions(by_view=by_view, source=str(path))


def _labels(data: Mapping[str, Any], path: Path, where: str) -> dict[int, str]:
    captions: dict[int, str] = {}
    for key, text in data.items():
        if not (key.isascii() and key.isdigit()) or not 1 <= int(key[:12]) < 2**31:
            raise InputError(f"{path}:{where} expected labels as numbers from 1, got {key[:40]!r} ({FORMS})")
        if not isinstance(text, str) or not text.strip():
            raise InputError(f"{path}:{where} label {key}: expected a caption as text, got {str(text)[:40]!r}")
        if len(text) > MAX_NAME:
            raise InputError(
                f"{path}:{where} label {key}: caption {text[:MAX_SHOWN]!r}… has {len(text):,} characters, expected at "
                f"most {MAX_NAME:,}"
            )
        if int(key) in captions:
            raise InputError(f"{path}:{where} label {int(key)} has two captions")
        captions[int(key)] = text.strip()
    return captions
