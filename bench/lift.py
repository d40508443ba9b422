"""Lifting 1280-channel maps: in a basis of rank 32 against dense loops over all channels, in one run.

    python bench/lift.py SCENE [--voxel 0.02] [--views 0] [--runs 5] [--quick]

Maps: `SyntheticTeacher` (rank 32 plus noise of 10 % of the energy, seed 0) on 24 × 32 cells, which is what a
teacher with patches of 14 pixels sees of a picture resized to 336 × 448. Blending weights with their transposes, and
the visibility of Gaussians' centers, are made beforehand and timed apart; so is finding the basis. Timed as the lift:
allocating the sums, projecting the maps onto the basis (for lifts in a basis), adding up all views, and dividing.

Ways:
    blend     the library: Bᵀ @ maps, all of B's entries
    center    the library: one entry for each visible center (OpenScene's and SplatDistill's rule)
    gather    the dense loop that one would write: for each view the features of the visible centers are gathered into
              one reused buffer and added to the rows of their Gaussians
The dense loops work on all channels; for each, the lift in the basis follows the same rule and is judged against it.

Memory is the growth of the peak of resident memory (VmHWM, set back before) during one lift. The maps and matrices are
there before, for all ways alike.

The errors are those of the lift in the basis against the dense loop, and of both against the same lift of maps without
noise: what the basis leaves out is mostly noise.
"""

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, Float64
from json_option import add_json_option, write_figures

from gsencoder.core.process import memory_growth
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import SeedConfig, seed
from gsencoder.fusion.basis import Moments, field_error, fit_basis
from gsencoder.fusion.lift import VisibilityConfig, center_matrix, ray_pixels
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.render.blend_cpu import grid_lattice
from gsencoder.types import FeatureBasis, FeatureMap, FeatureSpace, GaussianFeatures, Gaussians, Views

RAYS = 16
"""Rays over which a cell's features are averaged, as a patch of a vision transformer averages what it covers."""


class SyntheticTeacher:
    """A few random directions mixed by smooth functions of the 3D point that a pixel sees, plus noise and a mean.

    With x the world point of a pixel (from its depth), e_k random unit vectors of D channels and m a random vector of
    norm 1,

        features(x) = m + √(2(1 − noise) / rank) · Σ_k cos(ω_k · x + φ_k) e_k + √(noise / D) · n,    n ~ N(0, 1)

    so the energy about the mean is about 1 a cell, of which the share `noise` is spread evenly over all channels and
    differs between views, and the rest has rank `rank` and does not. Averaging over a cell's pixels takes a little off
    the finest waves. A cell without any depth has the mean and noise alone.
    """

    table = None
    mean = None
    needs_images = False
    cheap = True

    def __init__(
        self,
        *,
        channels: int = 1280,
        rank: int = 32,
        noise: float = 0.1,
        seed: int = 0,
        height: int = 24,
        width: int = 32,
        wavelength: float = 1.0,
    ) -> None:
        """Draws directions and waves, the shortest of `wavelength` world units and the longest four times as long."""
        self.noise, self.seed, self.height, self.width, self.wavelength = noise, seed, height, width, wavelength
        rng = np.random.default_rng(seed)
        directions = rng.standard_normal((rank, channels))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        self.directions: Float32[np.ndarray, "rank D"] = (directions * math.sqrt(2 * (1 - noise) / rank)).astype(
            np.float32
        )
        center = rng.standard_normal(channels)
        self.center: Float32[np.ndarray, " D"] = (center / np.linalg.norm(center)).astype(np.float32)
        waves = rng.standard_normal((rank, 3))
        lengths = wavelength * 4 ** rng.uniform(size=(rank, 1))
        self.waves: Float64[np.ndarray, "rank 3"] = (
            2 * np.pi * waves / np.linalg.norm(waves, axis=1, keepdims=True) / lengths
        )
        self.phases: Float64[np.ndarray, " rank"] = rng.uniform(0, 2 * np.pi, rank)
        self.space = FeatureSpace(
            name=f"synthetic-{channels}",
            channels=channels,
            teacher="synthetic",
            weights=f"seed {seed}, rank {rank}, noise {noise:g}",
            preprocessing=f"resize to {width}×{height} cells",
        )

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """The features of one view, which has depth; the same view gives the same noise."""
        cameras = views.cameras
        size = int(cameras.widths[view]), int(cameras.heights[view])
        affine = np.array([[self.width / size[0], 0, 0], [0, self.height / size[1], 0]])
        lattice = grid_lattice(affine, self.width, self.height, RAYS)
        y, x = ray_pixels(lattice, *size)
        z = views.depths[view][np.ix_(y, x)].astype(np.float64)
        points = cameras.unproject(np.stack(np.meshgrid(x + 0.5, y + 0.5), axis=-1), z, view)
        mixed = np.cos(points @ self.waves.T + self.phases) * (z > 0)[..., None]
        blocks = mixed.reshape(self.height, lattice.side, self.width, lattice.side, -1)
        rays = (z > 0).reshape(self.height, lattice.side, self.width, lattice.side).sum(axis=(1, 3))
        mixed = (blocks.sum(axis=(1, 3)) / np.maximum(rays, 1)[..., None]).astype(np.float32)
        features = np.random.default_rng([self.seed, view]).standard_normal(
            (self.height, self.width, self.space.channels), np.float32
        )
        features *= np.float32(math.sqrt(self.noise / self.space.channels))
        features += mixed @ self.directions
        features += self.center
        return FeatureMap(features=features, grid_from_image=affine, space=self.space)


RANK = 32
NOISE = 0.1
VISIBILITY = VisibilityConfig(against=("sensor",), relative=0.02)


@dataclass
class Problem:
    """All that a lift starts from."""

    gaussians: Gaussians
    maps: list[FeatureMap]
    clean: list[FeatureMap]
    blends: list[Blend]
    centers: list[Blend]
    basis: FeatureBasis
    mean: np.ndarray
    seconds: dict[str, float]


def prepare(path: str, voxel: float, count: int) -> Problem:
    scene = load_scene(path)
    gaussians = seed(scene, SeedConfig(voxel=voxel))
    views = scene.views
    chosen = range(len(views) if not count else min(count, len(views)))
    quiet = SyntheticTeacher(rank=RANK, noise=0.0)
    clean = [quiet.feature_map(views, view) for view in chosen]
    # Averaging over a cell takes energy off the signal, so less noise than its nominal share makes NOISE of the whole.
    energy = float(np.concatenate([rows_of(one) for one in clean]).var(axis=0, dtype=np.float64).sum())
    teacher = SyntheticTeacher(rank=RANK, noise=NOISE * energy / (1 - NOISE + NOISE * energy))
    maps = [teacher.feature_map(views, view) for view in chosen]
    seconds: dict[str, float] = {}
    blends = timed_list(seconds, "blending weights", lambda view: build(gaussians, views, view, maps[view]), chosen)
    centers = timed_list(seconds, "visible centers", lambda view: visible(gaussians, views, view, maps[view]), chosen)
    start = time.perf_counter()
    moments = Moments(teacher.space.channels)
    for one in maps:
        moments.add(one.features.reshape(-1, teacher.space.channels))
    covariance = moments.covariance()
    basis = fit_basis(moments.mean, covariance, teacher.space, energy=1.0, max_rank=RANK)
    seconds["basis"] = time.perf_counter() - start
    return Problem(gaussians, maps, clean, blends, centers, basis, basis.mean, seconds)


def timed_list(seconds: dict[str, float], name: str, make: Callable[[int], Blend], views: range) -> list[Blend]:
    make(views[0])
    start = time.perf_counter()
    made = [make(view) for view in views]
    seconds[name] = time.perf_counter() - start
    return made


def build(gaussians: Gaussians, views: Views, view: int, one: FeatureMap) -> Blend:
    made = blend(gaussians, views.cameras, view, like=one, config=BlendConfig())
    _ = made.transposed
    return made


def visible(gaussians: Gaussians, views: Views, view: int, one: FeatureMap) -> Blend:
    made = center_matrix(gaussians, views, view, one, [views.depths[view]], VISIBILITY, BlendConfig())
    _ = made.transposed
    return made


def rows_of(one: FeatureMap) -> np.ndarray:
    return one.features.reshape(-1, one.space.channels)


def lift_matrix(problem: Problem, matrices: list[Blend], basis: FeatureBasis | None) -> tuple[np.ndarray, np.ndarray]:
    """The library's way: sums and weights by sparse products, in a basis or in all channels."""
    columns = basis.rank if basis is not None else problem.mean.size
    sums = np.zeros((len(problem.gaussians), columns), np.float32)
    weights = np.zeros((len(problem.gaussians), 1), np.float32)
    for b, one in zip(matrices, problem.maps, strict=True):
        maps = rows_of(one)
        maps = basis.coordinates(maps) if basis is not None else maps
        b.lift_into(torch.from_numpy(maps), torch.from_numpy(sums))
        b.lift_into(torch.ones(len(maps), 1), torch.from_numpy(weights))
    np.divide(sums, weights, out=sums, where=weights > 0)
    return sums, weights[:, 0]


def lift_gather(problem: Problem, basis: FeatureBasis | None) -> tuple[np.ndarray, np.ndarray]:
    """The dense loop: visible rows only, one buffer for all views, torch's own gather and add."""
    assert basis is None
    n, channels = len(problem.gaussians), problem.mean.size
    # numpy's zeros lie in huge pages, which fill several times faster than torch's; a good loop takes them.
    sums = torch.from_numpy(np.zeros((n, channels), np.float32))
    weights = torch.zeros(n, 1)
    most = max(len(b.transposed[0]) for b in problem.centers)
    buffer = torch.from_numpy(np.empty((most, channels), np.float32))
    for b, one in zip(problem.centers, problem.maps, strict=True):
        rows, _, cells, _ = b.transposed
        part = buffer[: len(rows)]
        torch.index_select(torch.from_numpy(rows_of(one)), 0, cells.long(), out=part)
        sums.index_add_(0, rows, part)
        weights.index_add_(0, rows, torch.ones(len(rows), 1))
    sums.div_(weights.clamp(min=1))
    return sums.numpy(), weights[:, 0].numpy()


def lift_gather_blocks(problem: Problem, basis: FeatureBasis | None) -> tuple[np.ndarray, np.ndarray]:
    """The same in blocks of 1024 rows, so that the buffer stays in the processor's cache."""
    assert basis is None
    n, channels = len(problem.gaussians), problem.mean.size
    sums = torch.from_numpy(np.zeros((n, channels), np.float32))
    weights = torch.zeros(n, 1)
    buffer = torch.empty(1024, channels)
    for b, one in zip(problem.centers, problem.maps, strict=True):
        rows, _, cells, _ = b.transposed
        source = torch.from_numpy(rows_of(one))
        for some, where in zip(rows.split(1024), cells.long().split(1024), strict=True):
            part = buffer[: len(some)]
            torch.index_select(source, 0, where, out=part)
            sums.index_add_(0, some, part)
        weights.index_add_(0, rows, torch.ones(len(rows), 1))
    sums.div_(weights.clamp(min=1))
    return sums.numpy(), weights[:, 0].numpy()


Lift = Callable[[Problem, FeatureBasis | None], tuple[np.ndarray, np.ndarray]]

WAYS: dict[str, tuple[Lift, str]] = {
    "blend": (lambda p, basis: lift_matrix(p, p.blends, basis), "blend"),
    "center": (lambda p, basis: lift_matrix(p, p.centers, basis), "center"),
    "gather": (lift_gather, "center"),
    "gather in blocks": (lift_gather_blocks, "center"),
}
"""The lift, and the rule that it follows."""


def memory_of(problem: Problem, way: str, dense: bool) -> float:
    """How much one lift makes the process grow at its peak, MiB."""
    with memory_growth() as growth:
        WAYS[way][0](problem, None if dense else problem.basis)
    return growth.mib


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--voxel", type=float, default=0.02)
    parser.add_argument("--views", type=int, default=0, help="0 = all")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="6 views, 2 runs")
    add_json_option(parser)
    options = parser.parse_args()
    if options.quick:
        options.views, options.runs = 6, 2
    problem = prepare(options.scene, options.voxel, options.views)
    n, channels, views = len(problem.gaussians), problem.mean.size, len(problem.maps)
    both = (problem.blends, problem.centers)
    mean_columns = [round(float(np.mean([len(b.transposed[0]) for b in some]))) for some in both]
    print(f"{n:,} Gaussians, {views} views of 24 × 32 cells, {channels} channels, {torch.get_num_threads()} threads")
    print(f"a view reaches {mean_columns[0]:,} Gaussians by blending, {mean_columns[1]:,} by visible centers")
    for name, value in problem.seconds.items():
        print(f"{name + ' (apart)':24s} {value:.2f} s")
    print(f"basis of rank {problem.basis.rank} keeps {problem.basis.energy_kept:.3f} of the energy\n")

    entries = [(way, dense) for way in WAYS for dense in (False, True) if dense or "gather" not in way]
    seconds: dict[tuple[str, bool], list[float]] = {entry: [] for entry in entries}
    for run in range(options.runs + 1):
        for way, dense in entries:  # A B A B: what else the machine does falls on all alike.
            start = time.perf_counter()
            WAYS[way][0](problem, None if dense else problem.basis)
            if run:  # The first round warms up.
                seconds[way, dense].append(time.perf_counter() - start)
    median = {entry: float(np.median(values)) for entry, values in seconds.items()}
    memory = {entry: memory_of(problem, *entry) for entry in entries}
    print(f"{'way':18s}{'channels':>9s}{'seconds':>9s}{'(least, most)':>16s}{'MiB':>8s}")
    for entry in entries:
        spread = f"({min(seconds[entry]):.2f}, {max(seconds[entry]):.2f})"
        width = channels if entry[1] else problem.basis.rank
        print(f"{entry[0]:18s}{width:9d}{median[entry]:9.3f}{spread:>16s}{memory[entry]:8.0f}")
    print()
    figures: dict[str, dict[str, float]] = {}
    for way, rule in ((way, WAYS[way][1]) for way, dense in entries if dense):
        low, high = (rule, False), (way, True)
        narrow, wide = field(problem, *low), field(problem, *high)
        error = field_error(narrow, wide)
        figures[f"{rule} against {way}"] = {
            "faster": median[high] / median[low],
            "less memory": memory[high] / max(memory[low], 1e-9),
            "centered cosine error": error.centered,
        }
        print(
            f"{rule} in the basis against {way}, all channels: {median[high] / median[low]:.1f}× faster, "
            f"{memory[high] / max(memory[low], 1e-9):.1f}× less memory, centered cosine error {error.centered:.4f} "
            f"(raw {error.raw:.4f}; {error.covered:.1%} of the seen Gaussians)"
        )
        if way == rule:
            truth = field(replace(problem, maps=problem.clean), *high)
            found = field_error(narrow, truth).centered, field_error(wide, truth).centered
            print(f"    against maps without noise: in the basis {found[0]:.4f}, all channels {found[1]:.4f}")
        del narrow, wide
    write_figures(options.json, figures)


def field(problem: Problem, way: str, dense: bool) -> GaussianFeatures:
    basis = None if dense else problem.basis
    features, weights = WAYS[way][0](problem, basis)
    mean = np.mean([rows_of(one).mean(axis=0) for one in problem.maps], axis=0).astype(np.float32)
    space = problem.basis.space
    return GaussianFeatures(features=features, weights=weights, mean=mean, space=space, basis=basis)


if __name__ == "__main__":
    main()
