"""Surface samples of a mesh, or of RGB-D frames that are fused to one (TSDF)."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError
from gsencoder.data.seeding.depth import SurfaceGrid, read_rgbd
from gsencoder.data.seeding.points import flat_gaussians, seed_from_points
from gsencoder.types import Gaussians, Views

LATTICE = 0.5  # Spacing of the samples on a triangle, in voxels
LARGEST_SPACING = 2.0  # Upper limit of a Gaussian's spacing in voxels: samples of a mesh leave no wider gap
TRIANGLES = 20_000
TRUNCATION = 4.0  # How far the signed distance of fused frames reaches, in voxels of its grid
MAX_SAMPLES = 200_000_000  # A mesh that needs more samples than this for its area is in other units than the voxel


def seed_from_mesh(path: str | Path, *, voxel: float, origin: Float64[np.ndarray, "3"] | None = None) -> Gaussians:
    """Flat Gaussians on a mesh file (.ply .obj .glb .stl .off …) or on a point cloud in one.

    Triangles are sampled on a lattice of half a voxel, corners included, then averaged on the grid: a fine mesh gives
    its vertices' grid subsample, a coarse one has no holes. Colors come from the texture, the vertices or the faces,
    and are mid-grey where there are none. The parts of a scene graph are placed and joined.

    Args:
        path: the file; its coordinates are world coordinates.
        voxel: edge of the grid in the file's units.
        origin: the scene's origin, which is taken off in float64.
    """
    if not 0 < voxel < np.inf:
        raise InputError(f"seeds: voxel must be a positive length, got {voxel}")
    shift = np.zeros(3) if origin is None else origin
    grid, clouds = None, []
    for part in _parts(Path(path)):
        vertices = np.asarray(part.vertices, np.float64) - shift
        if not np.isfinite(vertices).all():
            bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
            raise InputError(f"{path}: {bad.size} of {len(vertices)} vertices are not finite (first: {bad[0]})")
        if not len(getattr(part, "faces", ())):
            clouds.append((vertices.astype(np.float32), getattr(part, "colors", None)))
            continue
        grid = grid or SurfaceGrid(voxel, np.median(vertices, axis=0))
        for points, normals, colors in _lattices(part, vertices, voxel, path):
            grid.add(points, normals, colors)
    samples = grid.samples() if grid else None
    if samples is not None and len(samples.points):
        return flat_gaussians(samples.points, samples.normals, samples.colors, largest=LARGEST_SPACING * voxel)
    if not clouds or not sum(len(points) for points, _ in clouds):
        raise InputError(f"{path}: holds no triangles of any area and no points; give a mesh of the scene")
    points = np.concatenate([cloud for cloud, _ in clouds])
    colored = all(colors is not None and len(colors) == len(cloud) for cloud, colors in clouds)
    tints = np.concatenate([np.asarray(colors)[:, :3] for _, colors in clouds]).astype(np.uint8) if colored else None
    return seed_from_points(points, tints, voxel=voxel)


def mesh_bounds(path: str | Path) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """Lower and upper corner of a mesh file's vertices."""
    vertices = [np.asarray(part.vertices, np.float64).reshape(-1, 3) for part in _parts(Path(path))]
    together = np.concatenate(vertices) if vertices else np.zeros((0, 3))
    if not len(together) or not np.isfinite(together).all():
        raise InputError(f"{path}: holds no vertices, or some that are not finite")
    return together.min(axis=0), together.max(axis=0)


def seed_from_tsdf(views: Views, *, voxel: float) -> Gaussians:
    """Flat Gaussians on the vertices of the mesh that RGB-D frames fuse to: the setting of SplatDistill, section 3.1.

    Slower than seeds from the frames themselves, and thin objects melt into what they lie on, but the noise of many
    frames is averaged away along the normal.

    Args:
        voxel: edge of the grid in world units; the signed distances are kept on one of half the size.
    """
    if not len(views) or views.depths is None or views.images is None:
        raise InputError("seeds: source=tsdf needs posed views with depth and images; use source=points or source=mesh")
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise InputError(
            f"seeds: source=tsdf needs open3d, which does not load ({' '.join(str(error).split())[:120]}); on "
            "Debian or Ubuntu: apt-get install libusb-1.0-0 libgl1"
        ) from error
    library: Any = open3d
    core, geometry = library.core, library.t.geometry
    fine = voxel / 2
    blocks = geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(core.float32, core.float32, core.float32),
        attr_channels=((1), (1), (3)),
        voxel_size=fine,
        block_resolution=16,
        block_count=10_000,
        device=core.Device("CPU:0"),
    )
    count = 0
    for view in range(len(views)):
        depth, image = read_rgbd(views, view)
        if views.masks is not None:
            depth = np.where(views.masks[view], depth, np.float32(0))
        far = float(depth.max(initial=0))
        if not (depth > 0).any():
            continue
        count += 1
        z = geometry.Image(core.Tensor(np.ascontiguousarray(depth)))
        rgb = geometry.Image(core.Tensor(np.ascontiguousarray(image, np.float32) / np.float32(255)))
        # Open3d's pixel centers lie on whole numbers.
        K = views.cameras.Ks[view].astype(np.float64)
        K[:2, 2] -= 0.5
        intrinsic, pose = core.Tensor(K), core.Tensor(views.cameras.cam_from_world[view].astype(np.float64))
        touched = blocks.compute_unique_block_coordinates(z, intrinsic, pose, 1.0, far, TRUNCATION)
        blocks.integrate(touched, z, rgb, intrinsic, intrinsic, pose, 1.0, far, TRUNCATION)
    if not count:
        raise InputError(f"seeds: none of the {len(views)} views has a depth above 0")
    mesh = blocks.extract_triangle_mesh(1.0)
    vertices = mesh.vertex.positions.numpy().astype(np.float32)
    if not len(vertices):
        raise InputError(f"seeds: the depth images fuse to no surface at {fine:g} units; take a larger voxel")
    normals = mesh.vertex.normals.numpy().astype(np.float32)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    colors = np.clip(mesh.vertex.colors.numpy(), 0, 1)
    grid = SurfaceGrid(voxel, np.median(vertices, axis=0))
    good = length[:, 0] > 1e-6
    grid.add(vertices[good], normals[good] / length[good], np.rint(255 * colors[good]).astype(np.uint8))
    samples = grid.samples()
    return flat_gaussians(samples.points, samples.normals, samples.colors, largest=LARGEST_SPACING * voxel)


def _parts(path: Path) -> list[Any]:
    """The meshes and point clouds of a file, in world coordinates."""
    import trimesh

    if not path.is_file():
        raise InputError(f"{path}: no such mesh file")
    try:
        loaded = trimesh.load_scene(path, process=False)
        return loaded.dump(concatenate=False)
    except Exception as error:  # trimesh's readers raise whatever their parsers do.
        message = " ".join(f"{type(error).__name__}: {error}".split())[:160]
        raise InputError(f"{path}: not a mesh that trimesh can read ({message})") from error


def _lattices(mesh: Any, vertices: np.ndarray, voxel: float, path: str | Path) -> Iterator[tuple[np.ndarray, ...]]:
    """Samples of the triangles, some thousand triangles at a time: positions, normals, colors."""
    faces = np.asarray(mesh.faces, np.int64)
    if faces.size and not (faces.min() >= 0 and faces.max() < len(vertices)):
        raise InputError(
            f"{path}: its triangles name vertices up to {faces.max()} of {len(vertices)}; the file is damaged"
        )
    corners = vertices[faces]
    # The longest edge becomes the first, so that slivers take few samples.
    edges = np.linalg.norm(corners[:, [1, 2, 0]] - corners, axis=2)
    turn = (edges.argmax(axis=1)[:, None] + np.arange(3)) % 3
    corners = np.take_along_axis(corners, turn[:, :, None], 1)
    length = edges.max(axis=1, initial=0)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(cross, axis=1)
    flat = double_area <= 1e-12 * length**2
    normals = cross / np.where(flat, 1, double_area)[:, None]
    step = LATTICE * voxel
    columns = np.ceil(length / step)
    rows = np.ceil(np.divide(double_area, length, out=np.zeros_like(length), where=length > 0) / step)
    samples = float((columns + 1) @ (rows + 1))
    if samples > MAX_SAMPLES:
        raise InputError(
            f"{path}: {samples:.3g} samples every {step:g} units; give a larger voxel, or the scene's metres_per_unit"
        )
    columns, rows = columns.astype(np.int64), rows.astype(np.int64)
    keep = np.flatnonzero(~flat)
    color_of = _colors(mesh, faces, turn)
    for start in range(0, len(keep), TRIANGLES):
        part = keep[start : start + TRIANGLES]
        owner, weights = _barycentric(columns[part], rows[part])
        which = part[owner]
        points = np.einsum("nk,nkc->nc", weights, corners[which]).astype(np.float32)
        yield points, normals[which].astype(np.float32), color_of(which, weights)


def _barycentric(columns: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A lattice of (columns + 1) × (rows + 1) weights on each triangle, and the triangle of each."""
    count = (columns + 1) * (rows + 1)
    owner = np.repeat(np.arange(len(count)), count)
    index = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    t = index // (columns[owner] + 1) / np.maximum(rows[owner], 1)
    s = index % (columns[owner] + 1) / np.maximum(columns[owner], 1) * (1 - t)
    return owner, np.stack([1 - s - t, s, t], axis=1)


def _colors(mesh: Any, faces: np.ndarray, turn: np.ndarray) -> Any:
    """A function from triangles and barycentric weights to uint8 RGB."""
    visual = mesh.visual
    uv = getattr(visual, "uv", None)
    if visual.kind == "texture" and uv is not None and len(uv) == len(mesh.vertices):
        material = visual.material
        corners = np.take_along_axis(np.asarray(uv, np.float64)[faces], turn[:, :, None], 1)
        return lambda which, weights: np.asarray(
            material.to_color(np.einsum("nk,nkc->nc", weights, corners[which])), np.uint8
        )[:, :3]
    if visual.kind == "vertex":
        tints = np.asarray(visual.vertex_colors)[:, :3].astype(np.float64)[faces]
        tints = np.take_along_axis(tints, turn[:, :, None], 1)
        return lambda which, weights: np.rint(np.einsum("nk,nkc->nc", weights, tints[which])).astype(np.uint8)
    if visual.kind == "face":
        flat = np.asarray(visual.face_colors)[:, :3].astype(np.uint8)
        return lambda which, _weights: flat[which]
    return lambda which, _weights: np.full((len(which), 3), 128, np.uint8)
