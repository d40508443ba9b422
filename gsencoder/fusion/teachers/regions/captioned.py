"""Regions whose vectors are those of captions: the text side of M3's LLaMA3 and SEEM regions (sec. 3.3)."""

import hashlib
import warnings
from typing import Any

import numpy as np
from jaxtyping import Float32, Int32

from gsencoder.core.errors import InputError, SceneWarning, about, listed
from gsencoder.fusion.teachers.regions.captions import Captions
from gsencoder.fusion.teachers.regions.masks import RegionMasks
from gsencoder.text.vocabulary import Words
from gsencoder.types import FeatureMap, FeatureSpace, Views

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
