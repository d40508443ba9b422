"""The IoU of axis-aligned boxes as the scripts of ScanRefer and Scan2Cap compute it (utils/box_util.py, box3d_iou)."""

import numpy as np
from jaxtyping import Float64

VOLUME_EPSILON = 1e-8
"""Volume that both add to a union, in cubic world units (metres, in ScanNet)."""


def box_ious(boxes: Float64[np.ndarray, "K 2 3"], box: Float64[np.ndarray, "2 3"]) -> Float64[np.ndarray, " K"]:
    """IoU of boxes with one: common volume / (volume + volume - common volume + 1e-8).

    So boxes without volume overlap nothing, and a box that is one quarter of another is below 0.25.

    Args:
        boxes: lower and upper corners, world units.
        box: the same of one box.
    """
    common = np.maximum(np.minimum(boxes[:, 1], box[1]) - np.maximum(boxes[:, 0], box[0]), 0)
    sizes, size = boxes[:, 1] - boxes[:, 0], box[1] - box[0]
    volume = common[:, 0] * common[:, 1] * common[:, 2]
    # The order of the operations decides ties at a threshold.
    union = sizes[:, 0] * sizes[:, 1] * sizes[:, 2] + size[0] * size[1] * size[2] - volume + VOLUME_EPSILON
    return volume / union
