"""Masks on disk as lazy sequences: which pixels of a view to use, and which show that nothing is there.

A pixel of the photograph is used if its mask file is not 0, alpha is at least one half, it is no background of one
color (background.py), and it has content in the distorted picture; each counts only where it exists. After scaling a
pixel counts only if all that it covers does.
"""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from gsencoder.data.readers.background import Background, outline
from gsencoder.data.readers.image_file import read_mask
from gsencoder.data.readers.images import PictureFiles, PixelGrid
from gsencoder.data.readers.undistort import RemapCache


class _OutlineFiles(PictureFiles[Bool[np.ndarray, "H W"]]):
    """Photographs of which transparency, or a background, tells where something is."""

    def __init__(
        self,
        paths: Sequence[Path | None],
        grids: Sequence[PixelGrid],
        remaps: RemapCache,
        outlined: Sequence[Path | None],
        background: Background | None = None,
    ) -> None:
        """Args:
        paths: mask files.
        grids: of the views.
        remaps: shared maps of undistortion.
        outlined: the photograph of each view that has transparency or a background; None = it has neither.
        background: of the scene.
        """
        super().__init__(paths, grids, remaps)
        self._outlined, self._background = tuple(outlined), background

    def _slice(self, rows: slice) -> "_OutlineFiles":
        return type(self)(self._paths[rows], self._grids[rows], self._remaps, self._outlined[rows], self._background)

    def _outline(self, view: int) -> tuple[Bool[np.ndarray, "H W"], Bool[np.ndarray, "H W"]] | None:
        """Used and empty pixels of the photograph, at the size of its file."""
        path = self._outlined[view]
        if path is None:
            return None
        state = path.stat()
        outlines = _last_outline(path, self._background, state.st_mtime_ns, state.st_size)
        foreground, empty = (self._turned(view, pixels) for pixels in outlines)
        self.check_size(view, foreground.shape)
        return foreground, empty

    def _fitted(self, view: int, pixels: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "h w"]:
        """Pixels of the file as pixels of the view."""
        from PIL import Image

        grid = self._grids[view]
        remap = self._remaps.get(grid.pinhole, grid.source)
        if remap is not None:
            pixels = remap.nearest(pixels)
        if pixels.shape != (grid.height, grid.width):
            grey = Image.fromarray(pixels.astype(np.uint8) * 255)
            pixels = np.asarray(grey.resize((grid.width, grid.height), Image.Resampling.BOX)) == 255
        return pixels


@lru_cache(maxsize=2)
def _last_outline(
    path: Path,
    background: Background | None,
    modified: int,  # noqa: ARG001
    size: int,  # noqa: ARG001
) -> tuple[Bool[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """The outline of a photograph; both kinds of masks ask for it one after the other."""
    return outline(path, background)


class MaskFiles(_OutlineFiles):
    """Which pixels to use, bool [H, W]."""

    def _load(self, view: int) -> Bool[np.ndarray, "H W"]:
        path, grid = self._paths[view], self._grids[view]
        pixels = np.ones((grid.source.height, grid.source.width), bool)
        if path is not None:
            pixels &= self._of_source(view, read_mask(path))
        outlines = self._outline(view)
        if outlines is not None:
            pixels &= outlines[0]
        return self._fitted(view, pixels)


class EmptyFiles(_OutlineFiles):
    """Which pixels show that nothing is there, bool [H, W]: transparent ones, and a background of one color."""

    def _load(self, view: int) -> Bool[np.ndarray, "H W"]:
        grid, outlines = self._grids[view], self._outline(view)
        if outlines is None:
            return np.zeros((grid.height, grid.width), bool)
        return self._fitted(view, outlines[1])
