"""The kernel that draws the triangles of a labeled mesh."""

from typing import no_type_check

import numpy as np

from gsencoder.core.process import compiled


# Without fused products, unlike `gsencoder.core.process.kernel`: of an edge of two triangles, each then finds a
# pixel exactly as far on its side as the other finds it beyond, and no pixel between them is left to neither.
@compiled
@no_type_check
def draw_triangles(local, faces, labels, K, near, inverse, instances):
    """Draws triangles into a buffer of 1/z, which is linear in the picture; the larger one is nearer."""
    height, width = instances.shape
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        if not (local[a, 2] > near and local[b, 2] > near and local[c, 2] > near):
            continue
        za, zb, zc = 1 / local[a, 2], 1 / local[b, 2], 1 / local[c, 2]
        ua, va = K[0, 0] * local[a, 0] * za + K[0, 2], K[1, 1] * local[a, 1] * za + K[1, 2]
        ub, vb = K[0, 0] * local[b, 0] * zb + K[0, 2], K[1, 1] * local[b, 1] * zb + K[1, 2]
        uc, vc = K[0, 0] * local[c, 0] * zc + K[0, 2], K[1, 1] * local[c, 1] * zc + K[1, 2]
        left, right = max(0.0, np.ceil(min(ua, ub, uc) - 0.5)), min(width - 1.0, np.floor(max(ua, ub, uc) - 0.5))
        top, bottom = max(0.0, np.ceil(min(va, vb, vc) - 0.5)), min(height - 1.0, np.floor(max(va, vb, vc) - 0.5))
        if left > right or top > bottom:
            continue
        area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua)
        if area == 0:
            continue
        for row in range(int(top), int(bottom) + 1):
            for column in range(int(left), int(right) + 1):
                u, v = column + 0.5, row + 0.5
                wa = ((ub - u) * (vc - v) - (vb - v) * (uc - u)) / area
                wb = ((uc - u) * (va - v) - (vc - v) * (ua - u)) / area
                # And not 1 - wa - wb, which rounds otherwise.
                wc = ((ua - u) * (vb - v) - (va - v) * (ub - u)) / area
                if wa < 0 or wb < 0 or wc < 0:
                    continue
                nearness = wa * za + wb * zb + wc * zc
                if nearness <= inverse[row, column]:
                    continue
                inverse[row, column] = nearness
                # Weights on the triangle itself, up to a common factor.
                wa, wb, wc = wa * za, wb * zb, wc * zc
                if wa >= wb and wa >= wc:
                    instances[row, column] = labels[a]
                elif wb >= wc:
                    instances[row, column] = labels[b]
                else:
                    instances[row, column] = labels[c]
