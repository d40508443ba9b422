"""Whether the photographs of a scene show the same colors at the same places, where depth says that places are the
same."""

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from gsencoder.data.check.depth_agreement import MIN_SAMPLES, DepthViews, shared_samples
from gsencoder.types import Views
from gsencoder.types.scene import project_points


def grey_pictures(views: Views, rows: Int64[np.ndarray, " V"], shape: tuple[int, int]) -> Float32[np.ndarray, "V h w"]:
    """Photographs in grey, 0 to 1, at the size of the small depth images."""
    from PIL import Image

    assert views.images is not None
    pictures = []
    for view in rows:
        grey = Image.fromarray(views.images[int(view)]).convert("L").resize(shape[::-1], Image.Resampling.BOX)
        pictures.append(np.asarray(grey, np.float32) / 255)
    return np.stack(pictures)


def color_correlations(
    views: DepthViews, grey: Float32[np.ndarray, "V h w"], Ks: Float64[np.ndarray, "V 3 3"]
) -> Float64[np.ndarray, "V V"]:
    """Correlation of the intensities of one place in view i and view j; NaN where they share too few places.

    A place is shared where the depth of both agrees within `TOLERANCE`.

    Args:
        views: depth under the reading that fits best.
        grey: photographs at the size of the depth images.
        Ks: intrinsics of these photographs.
    """
    result = np.full((len(views), len(views)), np.nan)
    for view, other, here, there in shared_samples(views, MIN_SAMPLES):
        intensities, in_view = _intensities(grey[view], Ks[view], here)
        other_intensities, in_other_view = _intensities(grey[other], Ks[other], there)
        pair = intensities[in_view & in_other_view], other_intensities[in_view & in_other_view]
        if len(pair[0]) >= MIN_SAMPLES and min(values.std() for values in pair) > 1e-3:
            result[view, other] = np.corrcoef(*pair)[0, 1]
    return result


def _intensities(
    grey: Float32[np.ndarray, "h w"], K: Float64[np.ndarray, "3 3"], local: Float64[np.ndarray, "n 3"]
) -> tuple[Float32[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """The intensity where points in camera axes project, and whether that is in the picture."""
    height, width = grey.shape
    pixels = project_points(local, K)
    in_view = np.asarray((pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1))
    columns, rows = np.floor(np.where(in_view[:, None], pixels, 0)).astype(np.int64).T
    return grey[rows, columns], in_view


def view_correlations(correlations: Float64[np.ndarray, "V V"]) -> Float64[np.ndarray, " V"]:
    """The median correlation of each view with the others, in both directions; NaN for a view that shares nothing."""
    both = np.concatenate((correlations, correlations.T), axis=1)
    result = np.full(len(both), np.nan)
    for view, row in enumerate(both):
        if np.isfinite(row).any():
            result[view] = np.nanmedian(row)
    return result
