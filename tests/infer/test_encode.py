"""Encoding scenes of any size: in parts as in one, and always all of it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rooms import merged
from splats import random_gaussians
from training_scenes import SMALL

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.infer import encode as module
from gsencoder.infer.encode import EncodeConfig, Encoder, cut, scene_regions
from gsencoder.infer.torch_network import TorchNetwork
from gsencoder.models.encoder import GaussianEncoder
from gsencoder.models.output_space import OutputSpace, OutputSpaces
from gsencoder.models.transformer import TransformerConfig
from gsencoder.types import FeatureSpace, GaussianFeatures, Gaussians

SPACE = OutputSpace(space=FeatureSpace(name="s", channels=5), mean=np.arange(5, dtype=np.float32), scale=2.0)
OUTPUTS = OutputSpaces(by_teacher={"s": SPACE})
WHOLE = EncodeConfig(chunk=0, precision="float32")


def encoder() -> GaussianEncoder:
    torch.manual_seed(0)
    return GaussianEncoder(SMALL, 5)


def encode(
    gaussians: Gaussians, network: GaussianEncoder, config: EncodeConfig, metres_per_unit: float = 1.0
) -> GaussianFeatures:
    return Encoder(TorchNetwork(network, OUTPUTS)).encode(gaussians, config, metres_per_unit=metres_per_unit)


class Recording(TorchNetwork):
    """A network that records what it is run on."""

    def __init__(self) -> None:
        super().__init__(encoder(), OUTPUTS)
        self.seen: list[Gaussians] = []

    def runner(self, *_: object) -> Callable[[Gaussians, object, int], np.ndarray]:
        def run(subset: Gaussians, curves: object, count: int) -> np.ndarray:
            self.seen.append(subset)
            return np.zeros((count, 5), np.float32)

        return run


@given(st.integers(1, 300), st.integers(1, 80), st.floats(0, 2), st.integers(0, 3))
@settings(max_examples=60)
def test_every_gaussian_is_some_chunks_own_once_and_no_chunk_is_too_large(count, chunk, halo, seed):
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(count, 3)).astype(np.float32)
    means[: count // 3] = 0.5  # Coincident ones cannot be cut apart by a plane.
    chunks = cut(means, chunk, halo)
    assert sorted(np.concatenate([one.core_rows for one in chunks]).tolist()) == list(range(count))
    for one in chunks:
        assert len(one.rows) <= chunk
        assert np.array_equal(one.rows[: len(one.core_rows)], one.core_rows)
        assert len(np.unique(one.rows)) == len(one.rows)


def plain_cut(means: np.ndarray, chunk: int, halo: float) -> list[tuple[list[int], list[int]]]:
    """`cut` as it is defined: every box is compared with all rows, and halved by a stable sort."""
    chunks = []
    pending = [(np.arange(len(means)), np.full(3, -np.inf), np.full(3, np.inf))]
    while pending:
        core, low, high = pending.pop()
        near = np.flatnonzero(((means >= low - halo) & (means <= high + halo)).all(axis=1))
        rest = np.setdiff1d(near, core)
        if len(core) + len(rest) <= chunk or len(core) <= max(1, chunk // 4):
            far = np.square(means[rest] - means[rest].clip(low, high)).sum(axis=1)
            nearest = np.sort(rest[np.argsort(far, kind="stable")[: max(0, chunk - len(core))]])
            chunks.append((core.tolist(), [*core.tolist(), *nearest.tolist()]))
            continue
        axis = int(np.argmax(np.ptp(means[core], axis=0)))
        order = core[np.argsort(means[core, axis], kind="stable")]
        half = len(core) // 2
        upper, lower = high.copy(), low.copy()
        upper[axis] = lower[axis] = means[order[half], axis]
        pending += [(np.sort(order[half:]), lower, high), (np.sort(order[:half]), low, upper)]
    return chunks


@pytest.mark.parametrize(("chunk", "halo"), [(200, 0.0), (200, 0.3), (300, 2.0), (50, 0.2), (2000, 0.3)])
@pytest.mark.parametrize("ties", [False, True])
def test_a_scene_is_cut_as_by_sorting_it_and_looking_at_all_rows_for_each_box(chunk, halo, ties):
    means = np.random.default_rng(0).normal(size=(1500, 3)).astype(np.float32) * np.float32([3, 2, 1])
    if ties:
        means = np.round(means * 2) / 2
        means[:300, 0] = 0.0
    expected = plain_cut(means, chunk, halo)
    assert [(one.core_rows.tolist(), one.rows.tolist()) for one in cut(means, chunk, halo)] == expected


def test_nothing_nearer_to_a_box_than_its_halo_is_left_out_of_its_chunk() -> None:
    """Where there is room for a part of the halo alone, it is as wide as the next row that is left out is far."""
    means = np.random.default_rng(0).uniform(0, 3, (2000, 3)).astype(np.float32)
    chunks = cut(means, 200, 0.5)
    narrow = [one for one in chunks if one.halo < 0.5]
    assert 0 < len(narrow) < len(chunks)
    for one in chunks:
        left_out = np.setdiff1d(np.arange(2000), one.rows)
        far = np.linalg.norm(means[left_out] - means[left_out].clip(one.low, one.high), axis=1).min()
        assert far == pytest.approx(one.halo) if one in narrow else far > 0.5
        around = one.seen_around(means)
        assert (around >= one.halo).all()
        gaps = np.linalg.norm(means[one.core_rows][:, None] - means[left_out], axis=2).min(axis=1)
        assert (gaps >= around - 1e-5).all()
    assert np.isinf(cut(means, 0, 0.5)[0].seen_around(means)).all()


def test_chunks_whose_halo_covers_what_a_token_sees_give_what_the_whole_gives() -> None:
    """A network of one level that attends to nothing but itself sees two cells far: stem and block, one each."""
    shape = TransformerConfig(
        encoder_depths=(1,), encoder_channels=(16,), decoder_depths=(), decoder_channels=(), head_channels=16, patch=1
    )
    config = replace(SMALL, transformer=shape)
    torch.manual_seed(0)
    network, one = GaussianEncoder(config, 5), random_gaussians(1500)
    encoded = encode(one, network, WHOLE)
    assert (encoded.weights == 1).all()
    whole = encoded.features
    for halo, exact in ((3 * config.voxel, True), (0.0, False)):
        chunks = cut(one.means, 700, halo)
        assert len(chunks) > 1
        assert all(len(chunk.rows) < 700 for chunk in chunks)  # None had its halo cut.
        parts = encode(one, network, replace(WHOLE, chunk=700, halo=halo)).features
        assert np.allclose(parts, whole, atol=1e-4) == exact


def test_the_unit_of_the_scene_is_taken_into_account() -> None:
    """A splat in centimetres is the same splat."""
    one = random_gaussians(200)
    one = replace(one, means=np.round(one.means * 512).astype(np.float32) / 512)
    in_quarters = replace(one, means=one.means * np.float32(4), scales=one.scales * np.float32(4))
    network = encoder()
    network.config = replace(SMALL, voxel=0.125)
    there = encode(in_quarters, network, WHOLE, metres_per_unit=0.25)
    np.testing.assert_allclose(there.features, encode(one, network, WHOLE).features, atol=1e-4)


def test_features_on_several_grids_are_the_mean_of_those_on_each() -> None:
    torch.manual_seed(0)
    of_size = replace(SMALL, inputs=("offset", "color", "cell"), coarser=(1.5, 2.0))
    network, scene = GaussianEncoder(of_size, 5), random_gaussians(80, seed=2)
    each = [encode(scene, network, replace(WHOLE, grids=(grid,))).decode() for grid in (0.1, 0.15, 0.2)]
    assert np.abs(each[0] - each[2]).max() > 0.01
    np.testing.assert_allclose(encode(scene, network, WHOLE).decode(), np.mean(each, axis=0), atol=1e-5)
    chosen = encode(scene, network, replace(WHOLE, grids=(0.2, 0.1))).decode()
    np.testing.assert_allclose(chosen, (each[0] + each[2]) / 2, atol=1e-5)
    in_feet = replace(scene, means=scene.means / np.float32(0.25), scales=scene.scales / np.float32(0.25))
    there = encode(in_feet, network, WHOLE, metres_per_unit=0.25).decode()
    np.testing.assert_allclose(there, np.mean(each, axis=0), atol=1e-5)


def seen_by(scene: Gaussians, config: EncodeConfig = WHOLE, unit: float = 1.0, **up: np.ndarray) -> list[Gaussians]:
    """What the network is run on."""
    network = Recording()
    Encoder(network).encode(scene, config, metres_per_unit=unit, **up)
    return network.seen


def test_a_splat_is_turned_so_that_up_is_z_and_its_floor_at_0() -> None:
    one = random_gaussians(300)
    (seen,) = seen_by(one, up=np.array([0.0, -1.0, 0.0]))
    np.testing.assert_allclose(seen.means[:, 2], np.quantile(one.means[:, 1], 0.99) - one.means[:, 1], atol=1e-4)


def test_a_halo_is_as_many_metres_wide_in_every_unit_of_length() -> None:
    one, config = random_gaussians(1500), EncodeConfig(chunk=700, halo=0.1)
    quarters = replace(one, means=one.means * np.float32(4))
    assert [len(part) for part in seen_by(one, config)] == [len(part) for part in seen_by(quarters, config, 0.25)]


def test_chunks_that_take_many_times_the_work_of_a_scene_are_warned_of_with_their_figures(monkeypatch):
    one = random_gaussians(1500)
    seen_by(one, EncodeConfig(chunk=200, halo=0.25), 0.5)
    monkeypatch.setattr(module, "MUCH_WORK", 10_000)
    seen_by(one, EncodeConfig(chunk=700, halo=0.1))
    chunks = cut(one.means, 200, 0.5)
    seen, narrow = sum(len(each.rows) for each in chunks), sum(each.halo < 0.495 for each in chunks)
    assert 0 < narrow < len(chunks)
    work = f"take about {(seen + 200 * len(chunks)) / 1500:.0f} times the work .* the 1,500 of the scene"
    figures = (
        f"^encode.chunk=200: {len(chunks):,} chunks, .* hold {seen:,} Gaussians, {work}; {narrow} of them have no "
    )
    figures += "room for a halo of 0.25 m.*larger encode.chunk="
    with pytest.warns(SceneWarning, match=figures) as caught:
        seen_by(one, EncodeConfig(chunk=200, halo=0.25, grids=(0.02, 0.04)), 0.5)
    assert len(caught) == 1


def moved(one: Gaussians, x: float) -> Gaussians:
    return replace(one, means=one.means + np.float32([x, 0, 0]))


def strays(count: int) -> Gaussians:
    """Further from one another, and from a room at the origin, than two cells."""
    return replace(random_gaussians(count), means=np.float32([[5e3 + 1e2 * i, 0, 0] for i in range(count)]))


@given(st.integers(1, 60), st.integers(1, 30), st.integers(0, 9), st.floats(-1e6, 1e6))
@settings(max_examples=40)
def test_regions_are_touching_cells_and_the_small_ones_are_one(count: int, least: int, seed: int, far: float) -> None:
    """As a flood fill finds them."""
    rng = np.random.default_rng(seed)
    voxel, edge = 0.1, 0.1 * module.REGION_CELL
    means = rng.integers(0, 5, (count, 3)) * edge * (2, 1, 1) + rng.uniform(0, edge, (count, 3)) + far
    means = means.astype(np.float32)
    cells = [tuple(cell) for cell in np.floor(means.astype(np.float64) / edge).astype(int)]
    unseen, components = set(cells), []
    while unseen:
        pending = [unseen.pop()]
        components.append(set(pending))
        while pending:
            here = pending.pop()
            near = {cell for cell in unseen if max(abs(a - b) for a, b in zip(cell, here, strict=True)) <= 1}
            components[-1] |= near
            unseen -= near
            pending += near
    rows = [[row for row, cell in enumerate(cells) if cell in component] for component in components]
    large = [one for one in rows if len(one) >= least]
    small = sorted(row for one in rows if len(one) < least for row in one)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "LEAST_REGION", least)
        numbers = scene_regions(means, voxel)
    found = [np.flatnonzero(numbers == number).tolist() for number in range(numbers.max() + 1)]
    assert sorted(found) == sorted([*large, *([small] if small else [])]) or len(components) == 1
    assert not small or found[-1] == small or not large
    assert len(components) > 1 or not numbers.any()


@pytest.mark.parametrize("chunk", [0, 700])
def test_rooms_that_are_far_apart_have_the_bits_that_each_has_alone(chunk: int) -> None:
    """Among strays, and with their rows mixed."""
    parts = [random_gaussians(1500), moved(random_gaussians(1100, 1), 100), strays(3)]
    part_of = np.random.default_rng(0).permutation(np.repeat(range(3), [len(part) for part in parts]))
    mixed = merged(*parts).select(np.argsort(np.argsort(part_of, kind="stable")))
    config, network = replace(WHOLE, chunk=chunk, halo=0.3), encoder()
    features = encode(mixed, network, config).features
    for number, part in enumerate(parts):
        assert np.array_equal(features[part_of == number], encode(part, network, config).features)


def test_places_that_are_thousands_of_cells_away_are_regions_of_their_own() -> None:
    cloud = random_gaussians(2000, seed=2).means * np.float32(0.1)
    means = np.concatenate([cloud + np.float32(256 * away) * np.float32([1, 0, 0]) for away in (0, 2000, 5000)])
    assert scene_regions(means, 1.0).tolist() == np.repeat([0, 1, 2], 2000).tolist()


def test_what_is_one_region_is_encoded_as_it_is() -> None:
    """A room, one Gaussian, all at one place, a line as long as the world, and small regions however far apart."""
    line = random_gaussians(2000)
    line = replace(line, means=np.arange(2000, dtype=np.float32)[:, None] * np.float32([10, 0, 0]))
    at_one_place = replace(line, means=np.zeros_like(line.means))
    halls = merged(*(moved(random_gaussians(99, seed), 100 * seed) for seed in range(5)))
    for scene in (random_gaussians(1500), random_gaussians(1), at_one_place, line, halls):
        (seen,) = seen_by(scene)
        assert seen is scene


def test_twenty_rooms_are_encoded_one_by_one_and_all_strays_together() -> None:
    rooms = [moved(random_gaussians(1000 + seed, seed), 100 * seed) for seed in range(20)]
    assert [len(one) for one in seen_by(merged(*rooms, strays(50)))] == [*range(1000, 1020), 50]


def test_a_stray_is_no_reason_to_refuse_a_room_though_it_lies_further_than_cells_can_be_numbered() -> None:
    room = random_gaussians(1500)
    for far in (1e6, 1e12, 3e38):
        assert [len(one) for one in seen_by(merged(room, moved(random_gaussians(1), far)))] == [1500, 1]


def test_a_rerun_gives_the_same_bits() -> None:
    one, two = (encode(random_gaussians(300), encoder(), EncodeConfig(chunk=100)).features for _ in range(2))
    assert np.array_equal(one, two)


@pytest.mark.parametrize("unit", [0.0, float("nan")])
def test_a_unit_that_is_not_positive_is_refused(unit: float) -> None:
    with pytest.raises(InputError, match="metres_per_unit: expected a positive number of metres"):
        encode(random_gaussians(5), encoder(), WHOLE, metres_per_unit=unit)


def test_an_encoder_that_overflows_is_told_of() -> None:
    network = encoder()
    with torch.no_grad():
        network.head_norm.weight.fill_(3e38)
    with pytest.raises(InputError, match="features are not finite"):
        encode(random_gaussians(20), network, WHOLE)


def test_a_gpu_that_is_not_there_is_refused() -> None:
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    with pytest.raises(InputError, match="sees no GPU"):
        encode(random_gaussians(5), encoder(), replace(WHOLE, device="cuda"))
