"""Samples and batches: which Gaussians they hold, what is changed at random, and that nothing else decides them."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from archives import rewrite
from hypothesis import given
from hypothesis import strategies as st
from joint_training import Datasets, batch_of, joint
from safetensors.numpy import load_file
from splats import front_camera, random_gaussians
from training_scenes import LOSSES, SMALL, samples, small_encoder

from gsencoder.core.errors import InputError
from gsencoder.data.up import turn, upright_gaussians
from gsencoder.geometry import covariances
from gsencoder.models.encoder import encoder_inputs
from gsencoder.render import BlendConfig, blend
from gsencoder.train import samples as module
from gsencoder.train.loop import ErrorsAsValues, join_unless_error, micro_batches
from gsencoder.train.losses import AdapterHead, Distillation, LossConfig, render_loss
from gsencoder.train.prepared import PreparedDataset, PreparedScene, ViewRows, nearest_codes
from gsencoder.train.samples import (
    Augmentation,
    SampleDataset,
    SamplingConfig,
    TrainingScene,
    _smooth_shifts,
    augment,
    choose_crop,
    crop_size,
    drop_random,
    in_frusta,
    join_samples,
    make_sample,
    nearest_rows,
    rarity_weights,
    restrict_rows,
    target_codes,
)
from gsencoder.types import SH_C0, Cameras, Gaussians


def same(first: object, second: object) -> bool:
    if isinstance(first, torch.Tensor):
        return torch.equal(first, second)  # type: ignore[arg-type]
    if isinstance(first, tuple):
        return all(same(a, b) for a, b in zip(first, second, strict=True))  # type: ignore[arg-type]
    return first == second


def test_a_sample_depends_on_the_seed_and_its_number_alone(dataset: tuple[PreparedDataset, list[str]]) -> None:
    one, other = samples(*dataset), samples(*dataset)
    other[7]
    torch.manual_seed(5)
    assert same(one[3], other[3])
    assert not same(one[3], one[4])
    assert not same(one[3], samples(*dataset, seed=4)[3])
    for epoch in range(2):
        assert {one[3 * epoch + step].name.split(" ")[0] for step in range(3)} == set(dataset[1])


@given(st.integers(1, 3), st.integers(1, 3), st.integers(1, 4), st.integers(0, 3), st.integers(1, 3))
def test_processes_share_a_step_and_a_resumed_run_goes_on_in_the_middle(batch, accumulate, world, first, steps):
    def numbers(rank: int, begin: int) -> list[list[int]]:
        return micro_batches(begin, first + steps, batch=batch, accumulate=accumulate, rank=rank, world=world)

    assert len(numbers(0, first)) == steps * accumulate
    sample_numbers = sorted(number for rank in range(world) for micro in numbers(rank, first) for number in micro)
    size = batch * accumulate * world
    assert sample_numbers == list(range(first * size, (first + steps) * size))
    assert numbers(0, 0)[-steps * accumulate :] == numbers(0, first)
    # One process with more micro-batches takes the samples of several.
    alone = micro_batches(first, first + steps, batch=batch, accumulate=accumulate * world, rank=0, world=1)
    assert sorted(alone) == sorted(micro for rank in range(world) for micro in numbers(rank, first))


def test_without_changes_a_sample_holds_the_scene_as_it_is(dataset: tuple[PreparedDataset, list[str]]) -> None:
    whole = SamplingConfig(gaussians=0, views=2)
    data = samples(*dataset, augmentation=None, sampling=whole)
    sample = data[0]
    source = next(scene for scene in data.scenes if sample.name.startswith(scene.name))
    assert len(sample.attributes) == len(source.first)
    everything = np.arange(len(source.first))
    (targets,), (part,) = sample.teachers, source.parts
    np.testing.assert_array_equal(targets.targets.numpy(), part.targets(everything))
    assert ((targets.loss_weights > 0).numpy() == (part.weights > 0)).all()


def test_the_rows_of_a_sample_are_those_of_the_view_in_the_dataset(dataset: tuple[PreparedDataset, list[str]]) -> None:
    """With all Gaussians and nothing changed, B is that of `render.blend`, and its render of the targets is near the
    teacher's own cells."""
    whole = SamplingConfig(gaussians=0, views=1)
    data = samples(*dataset, augmentation=None, sampling=whole, losses=LossConfig(rarity=0.0))
    sample = data[0]
    scene = next(each.first for each in data.scenes if sample.name.startswith(each.name))
    view = scene.view_names.index(sample.name.split("(")[1].rstrip(")"))
    config = BlendConfig(rays_per_patch=16)  # One a pixel.
    b = blend(scene.gaussians(np.arange(len(scene))), scene.cameras, view, patch=4, config=config)
    (targets,) = sample.teachers
    ours = targets.rows.blend(len(scene))
    opaque = b.alpha >= 0.5
    assert ours.rows == int(opaque.sum())
    torch.testing.assert_close(ours.alpha, b.alpha[opaque], rtol=2e-3, atol=2e-3)
    rendered = ours.render(targets.targets.float()) / ours.alpha[:, None]
    assert torch.cosine_similarity(rendered, targets.rows.targets, dim=1).mean() > 0.9


@pytest.mark.parametrize("most", [1, 2])
def test_of_many_scenes_the_latest_used_are_kept_open(dataset, monkeypatch, most):
    monkeypatch.setattr("gsencoder.train.samples.MAX_OPEN_FILES", most)
    data, used = samples(*dataset), list[str]()
    for number in range(9):
        used.append(data[number].name.split(" ")[0])
        opened = {scene.name for scene in data.scenes for part in scene.parts if "_arrays" in vars(part)}
        assert opened == set(list(dict.fromkeys(reversed(used)))[:most])


def test_scenes_of_two_teachers_have_two_files_of_those_that_are_open(datasets: Datasets, monkeypatch) -> None:
    monkeypatch.setattr("gsencoder.train.samples.MAX_OPEN_FILES", 4)
    data = joint(datasets)
    for number in range(9):
        assert data[number]
        opened = [scene for scene in data.scenes if "_arrays" in vars(scene.first)]
        assert len(opened) == min(number + 1, 2)


@pytest.mark.parametrize(
    ("render", "weights", "read"),
    [(1.0, {}, [True, True]), (1.0, {"heights": 0.0}, [True, False]), (0.0, {}, [False, False])],
)
def test_rows_of_views_are_read_for_a_render_loss_alone(datasets: Datasets, render, weights, read) -> None:
    data = joint(datasets, weights, losses=replace(LOSSES, render_weight=render))
    sample = SampleDataset(data.scenes[:2], data.recipe)[0]
    assert [len(each.rows.targets) > 0 for each in sample.teachers] == read


def test_samples_of_a_step_are_of_one_size_and_steps_of_many(dataset: tuple[PreparedDataset, list[str]]) -> None:
    crops = SamplingConfig(views=1, gaussians=300, smallest=20)
    data = samples(*dataset, augmentation=None, sampling=crops, step_samples=3)
    sizes = [len(data[number].attributes) for number in range(12)]
    assert [sizes[start : start + 3] for start in range(0, 12, 3)] == [[size] * 3 for size in sizes[::3]]
    assert len(set(sizes)) == 4


def in_units(scene: PreparedScene, metres: float | None) -> PreparedScene:
    """The same numbers in another unit."""
    other = PreparedScene(scene.path)
    cameras, _, up, names = other._header
    other._header = (cameras, metres, up, names)
    return other


@pytest.mark.parametrize(("metres", "voxel"), [(0.5, 0.2), (2.0, 0.05), (None, 0.1)])
def test_the_grid_has_the_encoders_voxel_in_metres(dataset, metres, voxel):
    """So many metres a unit are so many times fewer units a voxel; an unknown unit is taken for the metre."""
    assert SMALL.voxel == 0.1
    recipe = samples(*dataset, augmentation=None).recipe
    scene = dataset[0].scenes(dataset[1])[0]
    sample = SampleDataset([TrainingScene([in_units(scene, metres)])], recipe)[0]
    alike = [TrainingScene([in_units(scene, 1.0)])]
    expected = SampleDataset(alike, replace(recipe, encoder=replace(SMALL, voxel=voxel)))[0]
    assert same(sample, expected)


def test_gaussians_without_a_target_have_no_kind_and_no_part_in_the_loss(dataset, tmp_path):
    path = Path(shutil.copy(dataset[0].scenes(dataset[1])[0].path, tmp_path))
    arrays = load_file(path)
    rewrite(path, {**arrays, "weights": np.where(np.arange(len(arrays["means"])) % 5 == 0, 0, arrays["weights"])})
    scene = PreparedScene(path)
    recipe = samples(*dataset, augmentation=None, sampling=SamplingConfig(gaussians=0)).recipe
    codebook, power = recipe.teachers[0].codebook, recipe.losses.rarity
    squares = np.square(scene.targets(np.arange(len(scene)))[:, None] - codebook).sum(axis=2)
    expected = np.where(scene.weights > 0, squares.argmin(axis=1), -1)
    (codes,) = target_codes(TrainingScene([scene]), recipe)
    np.testing.assert_array_equal(codes, expected)
    (targets,) = SampleDataset([TrainingScene([scene])], recipe)[0].teachers
    np.testing.assert_array_equal(targets.codes.numpy(), expected)
    np.testing.assert_array_equal(targets.loss_weights.numpy(), rarity_weights(expected, power))


@pytest.mark.parametrize(
    "sampling", [SamplingConfig(views=2, gaussians=200, rare_centers=0.0), SamplingConfig(gaussians=0)]
)
def test_where_all_weights_are_1_samples_are_the_same_without_looking_up_classes(dataset, sampling, monkeypatch):
    data = samples(*dataset, sampling=sampling, losses=LossConfig(rarity=0.0, contrast_weight=0.0))
    assert not data.recipe.uses_classes(data.recipe.teachers[0])
    without = [data[number] for number in range(4)]
    data._codes.clear()
    monkeypatch.setattr(type(data.recipe), "uses_classes", lambda *_: True)
    for number, sample in enumerate(without):
        looked_up = data[number]
        for one, other in zip(sample.teachers, looked_up.teachers, strict=True):
            assert same(one._replace(codes=other.codes), other)
        assert same(sample._replace(teachers=()), looked_up._replace(teachers=()))


@pytest.mark.parametrize(
    ("sampling", "losses", "teacher", "used"),
    [
        ({}, {}, {}, False),
        ({"rare_centers": 0.1, "gaussians": 1}, {}, {}, True),
        ({"rare_centers": 0.1, "gaussians": 0}, {}, {}, False),
        ({}, {"rarity": 0.1}, {"classes": False}, True),
        ({}, {"contrast_weight": 0.1}, {"weight": 0.1}, True),
        ({}, {"contrast_weight": 0.1}, {"classes": False}, False),
        ({}, {"contrast_weight": 0.1}, {"weight": 0.0}, False),
    ],
)
def test_classes_are_looked_up_for_each_use_by_itself(dataset, sampling, losses, teacher, used):
    recipe = samples(
        *dataset,
        sampling=SamplingConfig(**({"gaussians": 200, "rare_centers": 0.0} | sampling)),
        losses=LossConfig(**({"rarity": 0.0, "contrast_weight": 0.0} | losses)),
    ).recipe
    assert recipe.uses_classes(replace(recipe.teachers[0], **teacher)) == used


def test_all_kinds_are_equally_often_the_center_of_a_sample(dataset, monkeypatch):
    recipe, drawn = samples(*dataset).recipe, list[np.ndarray]()

    def record(means: np.ndarray, cameras: Cameras, center_weights: np.ndarray, *rest: Any) -> Any:
        drawn.append(center_weights)
        return choose_crop(means, cameras, center_weights, *rest)

    monkeypatch.setattr("gsencoder.train.samples.choose_crop", record)
    for part in dataset[0].scenes(dataset[1]):
        scene = TrainingScene([part])
        (codes,) = target_codes(scene, recipe)
        make_sample(scene, (codes,), recipe, 200, np.random.default_rng(0))
        assert (drawn[-1][codes < 0] == 0).all()
        counts = np.bincount(codes[codes >= 0])
        sums = np.bincount(codes[codes >= 0], drawn[-1][codes >= 0])
        assert len(set(counts[counts > 0])) > 1
        np.testing.assert_allclose(sums[counts > 0], sums[counts > 0][0], rtol=1e-5)


def rows_of(weights: list[list[float]], valid: list[bool] | None = None) -> ViewRows:
    """Dense rows as compressed ones."""
    dense = np.array(weights, np.float32)
    counts = (dense > 0).sum(axis=1)
    return ViewRows(
        crow=np.concatenate(([0], np.cumsum(counts))).astype(np.int64),
        col=np.nonzero(dense)[1].astype(np.int32),
        weight=dense[dense > 0],
        targets=np.arange(len(dense), dtype=np.float32)[:, None],
        valid=np.array(valid if valid is not None else [True] * len(dense)),
    )


ALL = np.arange(4)


@pytest.mark.parametrize(
    ("row", "selected", "kept", "stays"),
    [
        (None, ALL, ALL, False),  # without a vector of the teacher
        ([0.4, 0.4, 0.0, 0.0], ALL, ALL, True),
        ([0.2, 0.2, 0.0, 0.0], ALL, ALL, False),  # too faint
        ([0.0, 0.0, 0.0, 0.0], ALL, ALL, False),  # empty
        ([0.9, 0.04, 0.0, 0.0], np.array([0]), np.array([0]), True),  # 96 % inside the selection
        ([0.8, 0.1, 0.0, 0.0], np.array([0]), np.array([0]), False),  # 89 %
        ([0.4, 0.4, 0.0, 0.0], ALL, np.array([0, 2, 3]), True),  # half was left out at random
        ([0.2, 0.6, 0.0, 0.0], ALL, np.array([0, 2, 3]), False),  # too much was
    ],
)
def test_rows_stay_where_they_mean_something(row, selected, kept, stays):
    view = rows_of([row or [1.0, 0, 0, 0], [1.0, 0, 0, 0]], [row is not None, True])
    restricted = restrict_rows(view, 4, selected, kept, LossConfig())
    assert restricted.targets.ravel().tolist() == ([0.0, 1.0] if stays else [1.0])
    assert restricted.col.max() < len(kept)


def test_samples_side_by_side_are_the_samples_alone(dataset: tuple[PreparedDataset, list[str]]) -> None:
    data = samples(*dataset)
    parts = [data[0], data[1]]
    batch = join_samples(parts, SMALL.transformer.patch)
    n = len(parts[0].attributes)
    b = batch.teachers[0].rows.blend(len(batch.attributes))
    field = torch.randn(len(batch.attributes), 3)
    expected = [
        part.teachers[0].rows.blend(len(part.attributes)).render(values)
        for part, values in zip(parts, (field[:n], field[n:]), strict=True)
    ]
    torch.testing.assert_close(b.render(field), torch.cat(expected))
    encoder = small_encoder().eval()
    with torch.no_grad():
        together = encoder(batch.attributes, batch.opacities, batch.plan)
        alone = [join_samples([part], SMALL.transformer.patch) for part in parts]
        apart = torch.cat([encoder(one.attributes, one.opacities, one.plan) for one in alone])
    torch.testing.assert_close(together, apart, rtol=1e-4, atol=1e-5)


def test_no_scenes_and_views_that_see_nothing_are_refused(dataset: tuple[PreparedDataset, list[str]]) -> None:
    data = samples(*dataset)
    with pytest.raises(InputError, match="no scenes"):
        SampleDataset([], data.recipe)
    scene = data.scenes[0]
    (part,) = scene.parts
    part._header[0].cam_from_world[:, 2, 3] -= 1000  # Both cameras now stand behind the wall and look away.
    data = SampleDataset([scene], replace(data.recipe, augmentation=Augmentation()))
    with pytest.raises(InputError, match=r"scene wall_0: sample: no Gaussian"):
        data[0]
    # From a worker it comes back as a value, and through the batch, so that it can be raised in its own words.
    error = ErrorsAsValues(data)[0]
    assert isinstance(error, InputError)
    assert join_unless_error([None, error, InputError("later")], join_samples) is error
    part._header[0].cam_from_world[:, 2, 3] += 1000


RNG = np.random.default_rng


def test_the_frustum_of_a_camera_is_what_its_pixels_look_at() -> None:
    camera = front_camera()
    points = np.random.default_rng(0).uniform(-4, 4, (2000, 3)).astype(np.float32)
    pose, K = camera.cam_from_world[0].astype(np.float64), camera.Ks[0]
    x, y, z = (points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    expected = (z > 0.01) & (u >= 0) & (u < camera.widths[0]) & (v >= 0) & (v < camera.heights[0])
    inside = in_frusta(points, camera)
    assert (inside == expected).mean() > 0.999  # Rounding may move a point on the border.
    assert 0 < inside.sum() < len(points)


@given(st.integers(1, 50), st.integers(1, 60))
def test_a_crop_holds_the_nearest(count: int, wanted: int) -> None:
    means = RNG(count).normal(size=(count, 3)).astype(np.float32)
    rows = nearest_rows(means, means[0], wanted)
    assert len(rows) == min(count, wanted)
    assert (np.diff(rows) > 0).all()
    distances = np.linalg.norm(means - means[0], axis=1)
    outside = np.setdiff1d(np.arange(count), rows)
    if len(outside):
        assert distances[rows].max() <= distances[outside].min() + 1e-6


def cameras(count: int) -> Cameras:
    """Cameras in a row that look along +z."""
    made = front_camera().select([0] * count)
    made.cam_from_world[:, 0, 3] = -10.0 * np.arange(count)
    return made


def cloud(count: int = 1000, places: int = 1) -> np.ndarray:
    """Points before the first cameras of a row."""
    points = RNG(0).uniform(-1, 1, (count, 3)) + np.array([0, 0, 3])
    points[:, 0] += 10 * (np.arange(count) % places)
    return points.astype(np.float32)


def test_without_a_limit_a_sample_is_all_that_its_views_see() -> None:
    points, row = cloud(1000, 4), cameras(4)
    config = SamplingConfig(views=2, gaussians=0)
    views, rows = choose_crop(points, row, np.ones(1000, np.float32), config, 0, RNG(0))
    assert len(set(views)) == 2
    assert np.array_equal(rows, np.flatnonzero(in_frusta(points, row.select(views))))


def test_the_views_of_a_crop_look_at_its_center() -> None:
    points, row = cloud(1000, 4), cameras(4)
    for seed in range(8):
        config = SamplingConfig(views=2)
        views, rows = choose_crop(points, row, np.ones(1000, np.float32), config, 50, RNG(seed))
        assert len(views) == 1  # No other camera of the row sees the same place.
        assert len(rows) == 50
        assert in_frusta(points[rows], row.select(views)).all()
        assert (np.diff(rows) > 0).all()


def test_a_crop_holds_the_gaussians_nearest_to_its_center_that_the_views_see() -> None:
    points, camera = cloud(), front_camera()
    chances = np.full(1000, 1e-9, np.float32)
    visible = np.flatnonzero(in_frusta(points, camera))
    chances[visible[7]] = 1
    config = SamplingConfig(views=1, rare_centers=1.0)
    _, rows = choose_crop(points, camera, chances, config, 20, RNG(0))
    distances = np.linalg.norm(points[visible] - points[visible[7]], axis=1)
    assert set(rows) == set(visible[np.argsort(distances)[:20]])


def test_a_camera_that_looks_into_the_void_gives_way_to_one_that_sees_something() -> None:
    points, row = cloud(50), cameras(3)  # All before the first camera.
    for size in (0, 5):
        for seed in range(6):
            views, rows = choose_crop(points, row, np.ones(50, np.float32), SamplingConfig(views=1), size, RNG(seed))
            assert len(rows)
            assert 0 in views


def test_a_scene_behind_its_cameras_is_an_error() -> None:
    behind = cloud(10) - np.array([0, 0, 9], np.float32)
    for size in (0, 5):
        with pytest.raises(InputError, match="no Gaussian lies in the frustum of any view"):
            choose_crop(behind, cameras(2), np.ones(10, np.float32), SamplingConfig(), size, RNG(0))


@given(st.integers(1, 40), st.floats(0, 0.9), st.integers(0, 50))
def test_thinning_out_leaves_something(count: int, most: float, seed: int) -> None:
    rows = np.arange(count) * 2
    remaining = drop_random(rows, most, RNG(seed))
    assert len(remaining) >= 1
    assert np.isin(remaining, rows).all()


def test_crops_are_of_sizes_in_equal_ratios() -> None:
    config = SamplingConfig(gaussians=400, smallest=25)
    sizes = [crop_size(config, RNG(seed)) for seed in range(99)]
    assert min(sizes) >= 25
    assert max(sizes) <= 400
    assert 70 < np.median(sizes) < 140  # 100 is as far from 25 as from 400.
    assert crop_size(SamplingConfig(gaussians=400, smallest=0), RNG(0)) == 400
    assert crop_size(SamplingConfig(gaussians=0), RNG(0)) == 0


NOTHING = Augmentation(**dict.fromkeys(Augmentation.__dataclass_fields__, 0.0))


def splat() -> Gaussians:
    return random_gaussians(30, center=(0, 0, 0))


def orthonormal(seed: int, mirrored: bool) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    return q @ np.diag([1, 1, -1]) if mirrored else q


@given(st.integers(0, 1000), st.booleans(), st.floats(0.2, 5))
def test_a_splat_turns_as_a_whole(seed: int, mirrored: bool, scale: float) -> None:
    one, matrix = splat(), orthonormal(seed, mirrored)
    turned = turn(one, matrix, scale)
    before = covariances(torch.from_numpy(one.quats), torch.from_numpy(one.scales)).double().numpy()
    after = covariances(torch.from_numpy(turned.quats), torch.from_numpy(turned.scales)).double().numpy()
    np.testing.assert_allclose(after, scale**2 * matrix @ before @ matrix.T, rtol=1e-3, atol=1e-4 * scale**2)
    np.testing.assert_allclose(turned.means, scale * one.means @ matrix.T, rtol=1e-4, atol=1e-4)


def test_with_every_amount_at_zero_nothing_changes_but_the_place_on_the_grid() -> None:
    one = splat()
    same = augment(one, np.random.default_rng(0), NOTHING, voxel=0.02)
    np.testing.assert_allclose(same.sh, one.sh, atol=1e-6)
    np.testing.assert_allclose(same.scales, one.scales)
    shift = same.means - one.means
    assert (np.abs(shift - shift[0]) < 1e-6).all()
    assert (shift >= -1e-6).all()
    assert (shift <= 0.02 + 1e-6).all()


def test_heights_stay_but_for_the_tilt_and_a_floor_that_is_not_found() -> None:
    one = replace(splat(), means=splat().means + np.array([5, 2, 1], np.float32))
    turned = augment(one, np.random.default_rng(3), replace(NOTHING, turn=30.0, askew=0.5, mirror=1.0), voxel=0.0)
    np.testing.assert_allclose(turned.means[:, 2], one.means[:, 2], atol=1e-4)
    moved = augment(one, np.random.default_rng(3), replace(NOTHING, lift=1.0), voxel=0.02)
    assert np.ptp(moved.means[:, 2] - one.means[:, 2]) < 1e-4
    assert abs(float(moved.means[0, 2] - one.means[0, 2])) > 0.1
    sized = augment(one, np.random.default_rng(3), replace(NOTHING, scale=0.5), voxel=0.0)
    assert np.ptp(sized.means[:, 2] / one.means[:, 2]) < 1e-4  # The floor stays at 0.
    found = [augment(one, np.random.default_rng(i), replace(NOTHING, lift=1e-9), voxel=0.02) for i in range(99)]
    assert 0.03 < np.std([each.means[0, 2] for each in found]) < 0.05


def test_a_crop_has_its_heights_above_the_scenes_floor_and_weights_by_its_own_counts(dataset, monkeypatch):
    given: list[Gaussians] = []
    monkeypatch.setattr(module, "encoder_inputs", lambda one, *rest: given.append(one) or encoder_inputs(one, *rest))
    sampling = SamplingConfig(views=1, gaussians=40, smallest=0)
    data = samples(*dataset, augmentation=None, sampling=sampling, losses=LossConfig(rarity=0.5))
    sample, (targets,) = data[0], data[0].teachers
    source = next(scene for scene in data.scenes if sample.name.startswith(scene.name)).first
    heights = upright_gaussians(source.gaussians(np.arange(len(source))), source.up).means[:, 2]
    assert np.abs(given[0].means[:, 2:] - heights).min(axis=1).max() < 1e-5
    np.testing.assert_allclose(targets.loss_weights, rarity_weights(targets.codes.numpy(), 0.5), rtol=1e-5)


def test_a_share_of_the_samples_is_of_the_stream(dataset, monkeypatch):
    data, names = samples(*dataset), list[str]()
    sample, made = data[0], SimpleNamespace(name="made")
    data.stream = SimpleNamespace(share=0.8, scene=lambda number: (made, ()))
    monkeypatch.setattr(module, "make_sample", lambda scene, *_: names.append(scene.name) or sample)
    assert all(data[number] is sample for number in range(400))
    assert names.count("made") / 400 == pytest.approx(0.8, abs=0.06)


def test_a_bend_moves_neighbors_alike_and_places_far_apart_each_by_itself() -> None:
    amount, one = 0.02, random_gaussians(4000, center=(0, 0, 0))
    apart = np.array([0.003, 0.0, 0.0], np.float32)
    moves = []
    for seed in range(20):
        shift = _smooth_shifts(np.concatenate([one.means, one.means + apart]), RNG(seed), amount)
        first, second = np.split(shift, 2)
        moves.append(first)
        # The slopes of waves whose height is a share of their length have a standard deviation of 2π times that share.
        slopes = np.linalg.norm(second - first, axis=1) / 0.003
        assert slopes.max() < 6 * 2 * np.pi * amount
    assert 0.005 < np.std(np.stack(moves)) < 0.04  # Waves are 30 cm to 2 m long.
    bent = augment(one, RNG(0), replace(NOTHING, bend=amount), voxel=0.0)
    assert np.ptp(bent.means - one.means, axis=0).min() > 1e-3
    np.testing.assert_allclose(bent.quats, one.quats, atol=1e-6)


def test_light_changes_brightness_and_black_stays_near_black() -> None:
    black = replace(splat(), sh=np.full((30, 1, 3), -0.5 / SH_C0, np.float32))
    lit = augment(black, np.random.default_rng(0), replace(NOTHING, light=0.9), voxel=0.1)
    np.testing.assert_allclose(lit.sh * SH_C0 + 0.5, 0, atol=1e-6)


def test_heads_of_a_teacher_are_in_its_render_loss_and_in_no_other_term(datasets: Datasets) -> None:
    data = joint(datasets)
    batch = batch_of(data, range(3))
    predicted = torch.randn(len(batch.attributes), 8)
    torch.manual_seed(5)
    heads = [(AdapterHead(torch.nn.Linear(4, 3), torch.zeros(3), 1.0), torch.nn.Identity())]
    encoder, teachers = small_encoder(8), data.recipe.teachers
    plain = Distillation(encoder, LOSSES, teachers).terms(predicted, batch)
    for number, name in enumerate(datasets):
        terms = Distillation(encoder, LOSSES, teachers, heads={name: heads}).terms(predicted, batch)
        rows, own = batch.teachers[number].rows, predicted.split([4, 4], dim=1)[number]
        expected = render_loss(own, rows.blend(len(own)), rows.targets, rows.row_weights, LOSSES, heads)
        torch.testing.assert_close(terms[f"{name}/render"], expected)
        assert not torch.isclose(terms[f"{name}/render"], plain[f"{name}/render"])
        for term in set(plain) - {f"{name}/render"}:
            torch.testing.assert_close(terms[term], plain[term])


def test_centers_are_drawn_by_the_classes_of_the_first_teacher_that_a_scene_has(datasets, monkeypatch):
    data = joint(datasets)
    given: list[np.ndarray] = []

    def choose(means: np.ndarray, cameras: object, weights: np.ndarray, *others: object) -> object:
        given.append(weights)
        return chosen(means, cameras, weights, *others)  # type: ignore[arg-type]

    chosen = module.choose_crop
    monkeypatch.setattr(module, "choose_crop", choose)
    for parts, number in (((0, 1), 0), ((None, 1), 1), ((0, None), 0)):
        scene = data.scenes[0]
        having = TrainingScene([None if part is None else scene.parts[part] for part in parts])
        SampleDataset([having], data.recipe)[0]
        own, codebook = scene.parts[number], data.recipe.teachers[number].codebook
        expected = np.zeros(len(own))
        seen = np.flatnonzero(own.weights)
        expected[seen] = rarity_weights(nearest_codes(codebook, own.targets(seen)), 1.0)
        np.testing.assert_allclose(given.pop(), expected, rtol=1e-5)


def test_recolored_samples_keep_their_shapes_and_are_gray_inverted_or_permuted() -> None:
    one = splat()
    changes = set()
    for seed in range(60):
        changed = augment(one, np.random.default_rng(seed), replace(NOTHING, recolor=1.0), voxel=0.02)
        np.testing.assert_allclose(changed.scales, one.scales)
        gray, was_gray = changed.sh.mean(axis=2), one.sh.mean(axis=2)
        saturated = np.ptp(changed.sh, axis=2).max() > 1e-4
        kind = "gray" if not saturated else "inverted" if (gray * was_gray < 0).all() else "permuted"
        np.testing.assert_allclose(gray, -was_gray if kind == "inverted" else was_gray, atol=1e-5)
        changes.add(kind)
    assert changes == {"gray", "inverted", "permuted"}


def test_scales_and_opacities_vary_as_those_that_are_fitted() -> None:
    one = splat()
    changed = augment(one, np.random.default_rng(0), replace(NOTHING, spread=0.3, fade=0.5), voxel=0.02)
    factors = np.log(changed.scales / one.scales)
    assert 0.2 < factors.std() < 0.4
    assert (changed.opacities <= one.opacities).all()
    assert (changed.opacities >= 0.5 * one.opacities).all()
    assert changed.opacities.min() < one.opacities.min()
