@kernel
def cnt_kernel(
    first, last, starts, members, gaussians, depths, least, most, shape, stop, keep, counts, rows, cols, weights
):
    """Front-to-back compositing of tiles [first, last): entries (row, Gaussian, weight), depth-ordered in a row, and
    the number of entries of each row.

    Gaussians are the outer loop, so that one that several rays of a patch meet becomes a single entry at once. Along
    a line of rays exp(−quadratic) is a product of two geometric sequences: g(u+1) = g(u)·r(u), r(u+1) = r(u)·q.
    """
    height, width, side, tile, tiles_x = shape
    cells = tile // side
    cell_of = np.arange(tile) // side
    count = 0
    C = np.zeros(8, np.int64)
    transmittance = np.empty((tile, tile), np.float64)
    # The first and the last open ray of each line: a Gaussian that only meets others there is passed over.
    open_from, open_to = np.empty(tile, np.int64), np.empty(tile, np.int64)
    sums = np.zeros(cells, np.float64)
    share = 1.0 / (side * side)
    for t in range(first, last):
        tile_u, tile_v = (t % tiles_x) * tile, (t // tiles_x) * tile
        end_u, end_v = min(tile, width * side - tile_u), min(tile, height * side - tile_v)
        transmittance[:] = 1.0
        # Behind the farthest depth of interest of its rays nothing of a tile matters.
        tile_end = np.float32(-np.inf)
        for cj in range(end_v // side):
            row = (tile_v // side + cj) * width + tile_u // side
            for ci in range(end_u // side):
                tile_end = max(tile_end, most[row + ci])
        open_from[:], open_to[:] = 0, end_u - 1
        open_rays = end_u * end_v
        for m in range(starts[t], starts[t + 1]):
            # Entries of one Gaussian in one tile are at most its cells: room is checked here, not at each of them.
            if count + cells * cells > len(rows):
                more = np.empty(len(rows) + 1024, np.int32)
                rows, cols = np.concatenate((rows, more)), np.concatenate((cols, more))
                weights = np.concatenate((weights, np.empty(len(more), np.float32)))
            g = members[m]
            C[0] += 1
            z = depths[g]
            if z > tile_end:
                break
            gu, gv, half_height = gaussians[g, 0] - tile_u, gaussians[g, 1] - tile_v, gaussians[g, 3]
            a, b, c = gaussians[g, 4], gaussians[g, 5], gaussians[g, 6]
            limit, opacity = gaussians[g, 7], gaussians[g, 8]
            f0, f1 = max(np.ceil(gv - half_height), 0.0), min(np.floor(gv + half_height), float(end_v - 1))
            if f0 > f1:
                continue
            v0, v1 = int(f0), int(f1)
            inv_a, q = 1.0 / a, math.exp(-a)
            for cj in range(cell_of[v0], cell_of[v1] + 1):
                row = (tile_v // side + cj) * width + tile_u // side
                low_u, high_u = tile, -1
                for j in range(max(v0, cj * side), min(v1, cj * side + side - 1) + 1):
                    C[1] += 1
                    if open_from[j] > open_to[j]:
                        continue
                    dv = j - gv
                    root = b * b * dv * dv - a * (c * dv * dv - limit)
                    if root < 0:
                        continue
                    half, middle = math.sqrt(root) * inv_a, gu - b * dv * inv_a
                    f0, f1 = max(np.ceil(middle - half), 0.0), min(np.floor(middle + half), float(open_to[j]))
                    if f1 < max(f0, float(open_from[j])):
                        continue
                    u0, u1 = int(f0), int(f1)
                    C[2] += 1
                    du = u0 - gu
                    value = opacity * math.exp(-0.5 * (a * du * du + c * dv * dv) - b * du * dv)
                    ratio = math.exp(-a * (du + 0.5) - b * dv) if u1 > u0 else 0.0
                    low_u, high_u = min(low_u, u0), max(high_u, u1)
                    row_transmittance = transmittance[j]
                    open_before = open_rays
                    for i in range(u0, u1 + 1):
                        C[3] += 1
                        alpha = min(value, ALPHA_MAX)
                        value *= ratio
                        ratio *= q
                        before = row_transmittance[i]
                        # A negative transmittance marks a ray that has stopped.
                        if alpha < ALPHA_MIN or before < 0:
                            continue
                        C[4] += 1
                        after = before * (1.0 - alpha)
                        if after <= stop or z > most[row + cell_of[i]]:
                            row_transmittance[i] = -1.0
                            open_rays -= 1
                            continue
                        row_transmittance[i] = after
                        sums[cell_of[i]] += alpha * before
                    if open_rays < open_before:
                        while open_from[j] <= open_to[j] and row_transmittance[open_from[j]] < 0:
                            open_from[j] += 1
                        while open_from[j] <= open_to[j] and row_transmittance[open_to[j]] < 0:
                            open_to[j] -= 1
                if high_u < 0:
                    continue
                for ci in range(cell_of[low_u], cell_of[high_u] + 1):
                    weight = sums[ci] * share
                    sums[ci] = 0.0
                    if weight > 0 and weight >= keep and z >= least[row + ci]:
                        rows[count] = row + ci
                        cols[count] = g
                        weights[count] = weight
                        counts[row + ci] += 1
                        count += 1
            if open_rays == 0:
                break
    return C
