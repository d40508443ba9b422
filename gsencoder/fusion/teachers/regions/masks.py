"""Masks of regions: for each pixel of a view the number of its region, from files or from the scene's instance maps."""

import hashlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int32

from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import digest_files
from gsencoder.data.readers.label_images import LABEL_SUFFIXES, label_files
from gsencoder.fusion.teachers import MissingInput
from gsencoder.types import Scene, Views
from gsencoder.types.orientation import turned

ENDINGS = tuple(ending for suffix in LABEL_SUFFIXES for ending in (suffix, suffix.upper()))
"""Of label images, as cameras and people write them."""
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".ppm")


@runtime_checkable
class RegionMasks(Protocol):
    """Tells each pixel of a view which region it belongs to.

    Attributes:
        needs_images: whether it looks at photographs.
        cheap: whether making masks twice costs less than keeping them.
    """

    @property
    def needs_images(self) -> bool: ...

    @property
    def cheap(self) -> bool: ...

    def labels(self, views: Views, view: int) -> Int32[np.ndarray, "H W"]:
        """The number of each pixel's region, 0 = none."""
        ...

    def settings(self) -> dict[str, Any]:
        """All that the masks depend on beside the views, as JSON values."""
        ...


class InstanceMasks:
    """The instance maps of the scene."""

    needs_images = False
    cheap = True

    def __init__(self, scene: Scene) -> None:
        """Checks that there are some.

        Raises:
            MissingInput: there are none.
        """
        if scene.views is None or scene.views.instances is None:
            raise MissingInput(
                "teacher regions: masks=instances: the scene has no instance maps (instance_file_path in "
                "transforms.json); give label images with masks=files teacher.folder="
            )
        self._instances = scene.views.instances

    def labels(self, views: Views, view: int) -> Int32[np.ndarray, "H W"]:
        """The instance map of a view.

        Raises:
            InputError: there is none, or it cannot be read.
        """
        if views.instances is None:
            raise MissingInput("teacher regions: masks=instances: the scene has no instance maps")
        return views.instances[view]

    def settings(self) -> dict[str, Any]:
        digest = hashlib.sha256()
        for labels in self._instances:
            digest.update(repr(labels.shape).encode() + np.ascontiguousarray(labels).tobytes())
        return {"masks": "instances", "labels": digest.hexdigest()[:16]}


class FileMasks:
    """Label images in a folder, one for each view of a scene."""

    needs_images = False
    cheap = True

    def __init__(self, scene: Scene, folder: str) -> None:
        """Finds the file of each view.

        Args:
            scene: whose views.
            folder: see `scene_path`.

        Raises:
            MissingInput: no such folder beside the scene.
            InputError: no folder is named or there, files that are missing, or several for one view.
        """
        if not folder:
            raise InputError(
                "teacher.folder= is missing: the folder of label images, one a view; or give "
                "masks=instances or masks=sam"
            )
        if scene.views is None:
            raise InputError("teacher regions: masks=files: the scene has no views that label images could belong to")
        self.folder = scene_path(scene, folder, "teacher.folder")
        if not self.folder.is_dir():
            raise InputError(f"teacher.folder: {self.folder} is no folder; expected one of label images")
        self._paths = label_paths(self.folder, scene.views.names)
        self._files = label_files(self._paths, scene.views)
        self._row_of = {name: row for row, name in enumerate(scene.views.names)}
        self._orientations = scene.views.orientations

    def labels(self, views: Views, view: int) -> Int32[np.ndarray, "H W"]:
        """The label image of a view.

        Raises:
            InputError: it cannot be read, or has another size than the photograph.
        """
        row = self._row_of[views.names[view]]
        labels: Int32[np.ndarray, "H W"] = self._files[row]
        # Files lie as photographs are stored; upright views have no orientations.
        if self._orientations is None or views.orientations is not None:
            return labels
        return turned(labels, self._orientations[row])

    def settings(self) -> dict[str, Any]:
        return {"masks": "files", "labels": digest_files(*self._paths)}


def scene_path(scene: Scene, name: str, option: str) -> Path:
    """A file or folder beside a scene: in the scene's folder, else at the path itself.

    Raises:
        MissingInput: there is none, and the name is relative, so that other scenes may have one.
        InputError: there is none at an absolute path, or the name stands for both.
    """
    beside = scene.folder / name if scene.folder is not None and not Path(name).is_absolute() else None
    existing = [path for path in (beside, Path(name)) if path is not None and path.exists()]
    if not existing:
        tried = " or ".join(str(path) for path in (beside, Path(name)) if path is not None)
        absent = InputError if Path(name).is_absolute() else MissingInput
        raise absent(f"{option}: nothing at {tried}")
    if len(existing) == 2 and not existing[0].samefile(existing[1]):
        raise InputError(
            f"{option}={name}: stands for {existing[0]} and for {existing[1].absolute()}; give a complete path"
        )
    return existing[0]


def view_stem(name: str) -> PurePosixPath:
    """A view's name without the ending of its picture; folders stay, unless they lead upwards."""
    path = PurePosixPath(name)
    stem = path.with_suffix("") if path.suffix.lower() in PICTURE_SUFFIXES else path
    return PurePosixPath(stem.name) if stem.is_absolute() or ".." in stem.parts else stem


def label_paths(folder: Path, names: Sequence[str]) -> list[Path]:
    """The label image of each view: called like the view, with another ending; the folders of a view's name may be left
    out where the rest is the name of no other view.

    Raises:
        InputError: views have no file, or several.
    """
    stems = [view_stem(name) for name in names]
    count = Counter(stem.name for stem in stems)
    paths: list[Path] = []
    missing: list[str] = []
    for name, stem in zip(names, stems, strict=True):
        bases = [folder / stem, folder / stem.name] if count[stem.name] == 1 else [folder / stem]
        # Not with_suffix, which would cut off the last part of "frame-000012.color".
        candidates = [base.with_name(base.name + suffix) for base in bases for suffix in ENDINGS]
        existing: list[Path] = []
        for path in dict.fromkeys(candidates):
            # A file system that ignores case has one file under both spellings of an ending.
            if path.is_file() and not any(path.samefile(other) for other in existing):
                existing.append(path)
        if len(existing) > 1:
            raise InputError(
                f"teacher.folder: view {name!r} has {len(existing)} label images, {existing[0]} and {existing[1]}; "
                "remove all but one"
            )
        paths += existing
        missing += [] if existing else [name]
    if missing:
        first = stems[list(names).index(missing[0])]
        raise InputError(
            f"teacher.folder: {folder}: {len(missing)} of {len(names)} views have no label image, first "
            f"{missing[0]!r}; expected {first} with the ending {', '.join(LABEL_SUFFIXES)} (the view's name "
            "with another ending; its folders may be left out where the rest is the name of no other view)"
        )
    if len(set(paths)) < len(paths):
        double = next(path for path in paths if paths.count(path) > 1)
        raise InputError(
            f"teacher.folder: {double} would belong to {paths.count(double)} views; rename the photographs"
        )
    return paths
