"""Captions of regions: a JSON file beside label images, or the names of the scene's objects."""

import hashlib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int32

from gsencoder.core.errors import InputError, SceneWarning, about, listed
from gsencoder.data.readers.transforms_json import read_json
from gsencoder.teachers.masks import RegionMasks, view_stem
from gsencoder.text.table import MAX_NAME, MAX_SHOWN
from gsencoder.text.vocabulary import Words
from gsencoder.types import FeatureMap, FeatureSpace, SceneObject, Views

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


IDENTITY = np.array([[1.0, 0, 0], [0, 1.0, 0]])


class CaptionedRegions:
    """Each pixel has the vector of its region's caption; pixels of no region, or of one without a caption, have none,
    or with `rest` that of something else: the direction of the text side's mean.

    Attributes:
        kinds: the captions, which are stored with the features as words.
        captions: rows of the table, "" where it is the mean's direction.
    """

    cheap = True

    def __init__(self, views: Views, masks: RegionMasks, captions: Captions, words: Words, *, rest: bool) -> None:
        """Embeds the captions, and looks at the labels of all views once.

        Args:
            views: of the scene.
            masks: of regions.
            captions: of their labels.
            words: turns captions into vectors.
            rest: whether the rest of a picture is something else; otherwise nothing is known of it.

        Raises:
            InputError: no region has a caption, a caption of a view has no region, or words lack a caption.

        Warns:
            SceneWarning: regions without a caption, or captions of labels that no view has.
        """
        self._masks, self._captions, self._rest = masks, captions, rest
        self.needs_images = masks.needs_images
        used = self._check_labels(views)
        self.kinds = tuple(sorted(used))
        self.captions = (*([""] if rest else []), *self.kinds)
        self.mean = words.mean
        with about("teacher regions: captions"):
            vectors = words.encode(self.kinds)
        if rest:
            direction = words.mean.astype(np.float64)
            direction /= np.sqrt((direction * direction).sum() + 1e-24)
            vectors = np.concatenate([direction.astype(np.float32)[None], vectors])
        self.table: Float32[np.ndarray, "C D"] = np.ascontiguousarray(vectors, np.float32)
        self._row_of = {caption: row for row, caption in enumerate(self.captions)}
        self.space = FeatureSpace(
            name=f"regions-{words.space.text_encoder}",
            channels=words.space.channels,
            teacher="regions",
            layer="captions of regions" + (", the rest as the mean" if rest else ""),
            text_encoder=words.space.text_encoder,
        )

    def _check_labels(self, views: Views) -> set[str]:
        """The captions that occur."""
        used: set[str] = set()
        bare: list[int] = []
        everywhere: set[int] = set()
        regions = 0
        lost: list[str] = []
        for view, name in enumerate(views.names):
            labels = np.unique(self._masks.labels(views, view))
            labels = labels[labels > 0]
            captions = self._captions.of_view(name)
            regions += len(labels)
            everywhere.update(labels.tolist())
            used |= {captions[label] for label in labels.tolist() if label in captions}
            bare += [label for label in labels.tolist() if label not in captions]
            absent = sorted(set(captions) - set(labels.tolist())) if self._captions.by_view is not None else []
            lost += [f"{name}: {label}" for label in absent]
        if not regions:
            raise InputError(
                f"teacher regions: the masks of all {len(views)} views are empty: they have no label above 0"
            )
        if not used:
            raise InputError(
                f"teacher regions: {self._captions.source}: none of its captions belongs to one of the {regions:,} "
                f"regions, whose labels are {listed([str(label) for label in sorted(everywhere)])}"
            )
        if bare:
            kinds = [str(label) for label in sorted(set(bare))]
            warnings.warn(
                f"teacher regions: {len(bare):,} of {regions:,} regions in {len(views)} views have no caption and "
                f"{'count as something else' if self._rest else 'no feature'}; their labels are {listed(kinds)}",
                SceneWarning,
                stacklevel=4,
            )
        if lost:
            # Small regions may be lost where pictures are made smaller.
            warnings.warn(
                f"teacher regions: {self._captions.source}: {len(lost)} labels are in no pixel of the masks of their "
                f"views: {listed(lost, 5)}",
                SceneWarning,
                stacklevel=4,
            )
        self._warn_of_unused(everywhere)
        return used

    def _warn_of_unused(self, labels: set[int]) -> None:
        shared = self._captions.shared
        # Objects of a scene may be hidden in all views; a file of captions was written for its masks.
        if shared is None or self._captions.source == "objects.json":
            return
        unused = sorted(set(shared) - labels)
        if unused:
            warnings.warn(
                f"teacher regions: {self._captions.source}: {len(unused)} of {len(shared)} labels occur in no mask: "
                f"{listed([str(label) for label in unused])}",
                SceneWarning,
                stacklevel=5,
            )

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """Codes at the resolution of the picture.

        Raises:
            InputError: the mask cannot be read.
        """
        labels = self._masks.labels(views, view)
        captions = self._captions.of_view(views.names[view])
        codes = codes_of(
            labels, {label: self._row_of[text] for label, text in captions.items() if text in self._row_of}
        )
        if self._rest:
            codes = np.maximum(codes, 0)
        return FeatureMap(codes=codes, table=self.table, grid_from_image=IDENTITY, space=self.space)

    def settings(self) -> dict[str, Any]:
        captions = self._captions.shared or self._captions.by_view
        digest = hashlib.sha256(self.table.tobytes() + repr(captions).encode("utf-8", "backslashreplace"))
        return {"name": "regions", "captions": digest.hexdigest()[:16], "rest": self._rest, **self._masks.settings()}


def codes_of(labels: Int32[np.ndarray, "H W"], row_of: dict[int, int]) -> Int32[np.ndarray, "H W"]:
    """For each pixel the row of its label, −1 for labels without one."""
    if not row_of:
        return np.full(labels.shape, -1, np.int32)
    captioned = np.array(sorted(row_of), np.int32)
    rows = np.array([row_of[int(label)] for label in captioned], np.int32)
    nearest = np.searchsorted(captioned, labels).clip(max=len(captioned) - 1)
    return np.where(captioned[nearest] == labels, rows[nearest], np.int32(-1))
