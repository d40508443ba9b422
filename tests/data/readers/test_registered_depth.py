"""Depth that is carried over from its sensor to the photograph."""

import numpy as np
from scipy.spatial.transform import Rotation

from gsencoder.data.readers.depth_images import register_depth


def test_registered_depth_follows_a_turned_and_shifted_sensor_pixel_by_pixel():
    """The oracle: each depth pixel as a point, projected; a plane that faces no camera has a depth everywhere."""
    height, width = 60, 80
    depth_K = np.array([[70.0, 0, 41], [0, 74, 29], [0, 0, 1]])
    color_K = np.array([[55.0, 0, 45], [0, 52, 33], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec([0.05, -0.08, 0.02]).as_matrix()
    matrix[:3, 3] = 0.06, -0.04, 0.1
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack(((columns - 41) / 70, (rows - 29) / 74, np.ones((height, width))), axis=2)
    normal, offset = np.array([0.3, -0.2, 1.0]), 2.0
    depth = (offset / (rays @ normal)).astype(np.float32)
    seen = register_depth(depth, depth_K, matrix, color_K, 90, 64)
    columns, rows = np.meshgrid(np.arange(90) + 0.5, np.arange(64) + 0.5)
    rays = np.stack(((columns - 45) / 55, (rows - 33) / 52, np.ones((64, 90))), axis=2)
    turned = matrix[:3, :3] @ normal
    exact = (offset + turned @ matrix[:3, 3]) / (rays @ turned)
    covered = seen > 0
    assert 0.3 < covered.mean() < 1
    assert np.abs(seen[covered] / exact[covered] - 1).max() < 0.02
    # The corners of the sensor's picture are the corners of what is covered, and inside there are no holes.
    corners = (
        depth[[0, 0, -1, -1], [0, -1, 0, -1], None]
        * np.stack([((u - 41) / 70, (v - 29) / 74, 1) for v in (0.5, 59.5) for u in (0.5, 79.5)])
    ) @ matrix[:3, :3].T + matrix[:3, 3]
    pixels = corners[:, :2] / corners[:, 2:] * (55, 52) + (45, 33)
    edges = [(pixels[a], pixels[b]) for a, b in ((0, 1), (1, 3), (3, 2), (2, 0))]
    sides = np.stack([
        (end - start)[0] * (rows - start[1]) - (end - start)[1] * (columns - start[0])
        for start, end in edges
    ]) / np.array([np.linalg.norm(end - start) for start, end in edges])[:, None, None]  # fmt: skip
    within = sides.min(axis=0)
    assert covered[within > 0].all()
    assert not covered[within < -1.5].any()


def test_a_pixel_of_depth_covers_its_own_square_a_tenth_wider():
    depth = np.zeros((3, 4), np.float32)
    depth[1, 2] = 2.0
    sensor = np.array([[10.0, 0, 2], [0, 10, 1.5], [0, 0, 1]])
    # Its center is at (2.5, 1.5), twenty small pixels wide: 40 to 60 and 20 to 40, and a pixel more on each side.
    wide = register_depth(depth, sensor, np.eye(4), np.array([[200.0, 0, 40], [0, 200, 30], [0, 0, 1]]), 80, 60)
    assert set(np.flatnonzero(wide.any(axis=0))) == set(range(39, 61))
    assert set(np.flatnonzero(wide.any(axis=1))) == set(range(19, 41))
