"""The photographs that a reconstruction is fitted to, in memory, downscaled on demand."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha1

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.core.process import Track, untracked
from gsencoder.types import Cameras, Views


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaledPhotograph:
    """One photograph at one size."""

    image: Float[Tensor, "H W 3"]  # RGB in [0, 1]
    mask: Bool[Tensor, "H W"] | None  # pixels to look at; None = all
    depth: Float[Tensor, "H W"] | None  # z in world units, 0 = unknown; None where there is no sensor
    K: Float[Tensor, "3 3"]  # intrinsics at this size, in pixels
    # Pixels in which nothing is to be seen; None = nothing is known to be empty.
    empty: Bool[Tensor, "H W"] | None = None


class Photographs:
    """Views of a scene as tensors: photographs as bytes, masks, and depth in float32.

    Attributes:
        cameras: of all views, at full size.
        orientations: of all views, EXIF's; 1 = upright.
        masks: pixels of each photograph that count; None where all do.
        empty: pixels of each in which nothing is to be seen; None where nothing is known to be empty.
    """

    def __init__(self, views: Views, *, track: Track = untracked) -> None:
        """Decodes every picture once."""
        if views.images is None:
            raise InputError("the scene has cameras but no photographs")
        self.cameras: Cameras = views.cameras
        self.names = views.names
        self.orientations = views.orientations or (1,) * len(self.names)
        self._images: list[Tensor] = []
        self.masks: list[Tensor | None] = []
        self.empty: list[Tensor | None] = []
        self._depths: list[Tensor | None] = []
        for view in track(range(len(self.names)), "reading photographs"):
            self._images.append(torch.from_numpy(np.ascontiguousarray(views.images[view])))
            mask = None if views.masks is None else torch.from_numpy(np.ascontiguousarray(views.masks[view]))
            self.masks.append(None if mask is None or bool(mask.all()) else mask)
            empty = None if views.empty is None else torch.from_numpy(np.ascontiguousarray(views.empty[view]))
            self.empty.append(None if empty is None or not bool(empty.any()) else empty)
            self._depths.append(None if views.depths is None else torch.from_numpy(views.depths[view].copy()))

    def __len__(self) -> int:
        return len(self._images)

    def digest(self) -> str:
        """A digest of photographs, masks, depths and poses."""
        digest = sha1()
        arrays = [getattr(self.cameras, name) for name in ("cam_from_world", "Ks", "widths", "heights")]
        lists: list[Sequence[Tensor | None]] = [self._images, self.masks, self._depths]
        if any(empty is not None for empty in self.empty):
            lists.append(self.empty)
        for part in itertools.chain(*lists):
            arrays.append(np.empty(0) if part is None else part.numpy())
        for name, array in zip((*"ptwh", *len(lists) * self.names), arrays, strict=True):
            digest.update(f"{name}{array.shape}{array.dtype}".encode())
            digest.update(np.ascontiguousarray(array).data)
        return digest.hexdigest()[:16]

    def at_scale(self, view: int, shrink: int = 1) -> ScaledPhotograph:
        """A view; each of its pixels stands for `shrink` × `shrink` of the photograph's.

        Colors are averaged. A pixel is looked at, or empty, if all it covers is, and its depth is known if all it
        covers differ by less than 5 %. Lines and columns that do not fill a pixel are left out.
        """
        image = self._images[view].float() / 255
        mask, empty, depth = self.masks[view], self.empty[view], self._depths[view]
        K = torch.from_numpy(self.cameras.Ks[view].copy())
        if shrink > 1:
            image = torch.nn.functional.avg_pool2d(image.permute(2, 0, 1), shrink).permute(1, 2, 0).contiguous()
            mask, empty = (None if part is None else _all_of(part, shrink) for part in (mask, empty))
            if depth is not None:
                far, close = (torch.nn.functional.max_pool2d(sign * depth[None], shrink)[0] for sign in (1, -1))
                depth = torch.where((far + close <= 0.05 * far) & (close < 0), (far - close) / 2, 0)
            K[:2] /= shrink
        return ScaledPhotograph(image=image, mask=mask, empty=empty, depth=depth, K=K)


def _all_of(pixels: Bool[Tensor, "H W"], shrink: int) -> Bool[Tensor, "h w"]:
    """For each block of pixels whether all are True."""
    return torch.nn.functional.avg_pool2d(pixels.float()[None], shrink)[0] > 1 - 1e-6
