"""Samples and batches: where they come from, what they keep to, and that nothing else decides them."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from archives import rewrite
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load_file
from training_scenes import SMALL, DenseSideTeacher, prepared, samples, small_encoder

from gsencoder.core.errors import InputError
from gsencoder.render import BlendConfig, blend
from gsencoder.train.loop import StepSampler
from gsencoder.train.losses import LossConfig
from gsencoder.train.prepare import PreparedDataset
from gsencoder.train.prepared_file import PreparedScene, ViewRows
from gsencoder.train.samples import (
    Augmentation,
    SampleDataset,
    SamplingConfig,
    TrainingScene,
    choose_crop,
    join_samples,
    make_sample,
    restrict_rows,
    target_codes,
)
from gsencoder.types import Cameras


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


def test_every_pass_shows_every_scene_once(dataset: tuple[PreparedDataset, list[str]]) -> None:
    data = samples(*dataset)
    for epoch in range(3):
        seen = {data[3 * epoch + step].name.split(" ")[0] for step in range(3)}
        assert seen == set(dataset[1])


@given(st.integers(1, 3), st.integers(1, 3), st.integers(1, 4), st.integers(0, 3), st.integers(1, 3))
def test_processes_share_a_step_and_a_resumed_run_goes_on_in_the_middle(
    batch: int, accumulate: int, world: int, first: int, steps: int
) -> None:
    def numbers(rank: int, begin: int) -> list[list[int]]:
        return list(StepSampler(begin, first + steps, batch=batch, accumulate=accumulate, rank=rank, world=world))

    sampler = StepSampler(first, first + steps, batch=batch, accumulate=accumulate, rank=0, world=world)
    assert len(sampler) == len(list(sampler)) == steps * accumulate
    sample_numbers = sorted(number for rank in range(world) for micro in numbers(rank, first) for number in micro)
    size = batch * accumulate * world
    assert sample_numbers == list(range(first * size, (first + steps) * size))
    assert numbers(0, 0)[-steps * accumulate :] == numbers(0, first)


def test_one_process_with_more_micro_batches_takes_the_samples_of_several(
    dataset: tuple[PreparedDataset, list[str]],
) -> None:
    alone = list(StepSampler(0, 2, batch=1, accumulate=2, rank=0, world=1))
    pair = [list(StepSampler(0, 2, batch=1, accumulate=1, rank=rank, world=2)) for rank in range(2)]
    assert alone == [micro for step in zip(*pair, strict=True) for micro in step]


def test_without_changes_a_sample_holds_the_scene_as_it_is(dataset: tuple[PreparedDataset, list[str]]) -> None:
    whole = SamplingConfig(scope="scene", gaussians=0, views=2)
    data = samples(*dataset, augmentation=None, sampling=whole)
    sample, source = data[0], None
    for scene in data.scenes:
        if sample.name.startswith(scene.name):
            source = scene
    assert source is not None
    assert len(sample.attributes) == len(source.first)
    everything = np.arange(len(source.first))
    (targets,), (part,) = sample.teachers, source.parts
    assert part is not None
    np.testing.assert_array_equal(targets.targets.numpy(), part.targets(everything))
    assert ((targets.loss_weights > 0).numpy() == (part.weights > 0)).all()


def test_the_rows_of_a_sample_are_those_of_the_view_in_the_dataset(dataset: tuple[PreparedDataset, list[str]]) -> None:
    """With all Gaussians and nothing changed, B is that of `render.blend`, and its render of the targets is near the
    teacher's own cells."""
    whole = SamplingConfig(scope="scene", gaussians=0, views=1)
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
def test_of_many_scenes_the_latest_used_are_kept_open(
    dataset: tuple[PreparedDataset, list[str]], monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    monkeypatch.setattr("gsencoder.train.samples.MAX_OPEN_FILES", most)
    data, used = samples(*dataset), list[str]()
    for number in range(9):
        used.append(data.make(number).name.split(" ")[0])
        opened = {scene.name for scene in data.scenes for part in scene.parts if "_arrays" in vars(part)}
        assert opened == set(list(dict.fromkeys(reversed(used)))[:most])


def test_samples_of_a_step_are_of_one_size_and_steps_of_many(dataset: tuple[PreparedDataset, list[str]]) -> None:
    crops = SamplingConfig(scope="scene", views=1, gaussians=300, smallest=20)
    data = samples(*dataset, augmentation=None, sampling=crops, step_samples=3)
    sizes = [len(data.make(number).attributes) for number in range(12)]
    assert [sizes[start : start + 3] for start in range(0, 12, 3)] == [[size] * 3 for size in sizes[::3]]
    assert len(set(sizes)) == 4


def in_units(scene: PreparedScene, metres: float | None) -> PreparedScene:
    """The same numbers in another unit."""
    other = PreparedScene(scene.path)
    cameras, _, up, names = other._header
    other._header = (cameras, metres, up, names)
    return other


@pytest.mark.parametrize(("metres", "voxel"), [(0.5, 0.2), (2.0, 0.05), (None, 0.1)])
def test_the_grid_has_the_encoders_voxel_in_metres(
    dataset: tuple[PreparedDataset, list[str]], metres: float | None, voxel: float
) -> None:
    """So many metres a unit are so many times fewer units a voxel; an unknown unit is taken for the metre."""
    assert SMALL.voxel == 0.1
    recipe = samples(*dataset, augmentation=None).recipe
    scene = dataset[0].scenes(dataset[1])[0]
    sample = SampleDataset([TrainingScene([in_units(scene, metres)])], recipe)[0]
    alike = [TrainingScene([in_units(scene, 1.0)])]
    expected = SampleDataset(alike, replace(recipe, encoder=replace(SMALL, voxel=voxel)))[0]
    assert same(sample, expected)


def test_gaussians_without_a_target_have_no_kind_and_no_part_in_the_loss(
    dataset: tuple[PreparedDataset, list[str]], tmp_path: Path
) -> None:
    path = Path(shutil.copy(dataset[0].scenes(dataset[1])[0].path, tmp_path))
    arrays = load_file(path)
    rewrite(path, {**arrays, "weights": np.where(np.arange(len(arrays["means"])) % 5 == 0, 0, arrays["weights"])})
    scene = PreparedScene(path)
    recipe = samples(*dataset, augmentation=None, sampling=SamplingConfig(scope="scene", gaussians=0)).recipe
    balance, power = recipe.teachers[0].class_balance, recipe.losses.rarity
    squares = np.square(scene.targets(np.arange(len(scene)))[:, None] - balance.codebook).sum(axis=2)
    expected = np.where(scene.weights > 0, squares.argmin(axis=1), -1)
    (codes,) = target_codes(TrainingScene([scene]), recipe)
    np.testing.assert_array_equal(codes, expected)
    (targets,) = SampleDataset([TrainingScene([scene])], recipe)[0].teachers
    np.testing.assert_array_equal(targets.codes.numpy(), expected)
    np.testing.assert_array_equal(
        targets.loss_weights.numpy(), np.where(expected < 0, 0, balance.class_weights(power)[expected])
    )


@pytest.mark.parametrize(
    "sampling", [SamplingConfig(views=2, gaussians=200, rare_centers=0.0), SamplingConfig(gaussians=0)]
)
def test_where_all_weights_are_1_samples_are_the_same_without_looking_up_classes(
    dataset: tuple[PreparedDataset, list[str]], sampling: SamplingConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = samples(*dataset, sampling=sampling, losses=LossConfig(rarity=0.0, contrast_weight=0.0))
    assert not data.recipe.uses_classes(data.recipe.teachers[0])
    without = [data.make(number) for number in range(4)]
    data._codes.clear()
    monkeypatch.setattr(type(data.recipe), "uses_classes", lambda *_: True)
    for number, sample in enumerate(without):
        looked_up = data.make(number)
        for one, other in zip(sample.teachers, looked_up.teachers, strict=True):
            assert same(one._replace(codes=other.codes), other)
        assert same(sample._replace(teachers=()), looked_up._replace(teachers=()))


@pytest.mark.parametrize(
    "changes",
    [
        {"sampling": SamplingConfig(views=2, gaussians=200)},
        {"losses": LossConfig(rarity=0.0, contrast_weight=0.3)},
        {"losses": LossConfig(rarity=0.5, contrast_weight=0.0)},
    ],
)
def test_classes_are_looked_up_for_rare_centers_contrast_or_weights_of_rare_classes(
    dataset: tuple[PreparedDataset, list[str]], changes: dict[str, Any]
) -> None:
    nothing = {
        "sampling": SamplingConfig(views=2, gaussians=200, rare_centers=0.0),
        "losses": LossConfig(rarity=0.0, contrast_weight=0.0),
    }
    recipe = samples(*dataset, **{**nothing, **changes}).recipe
    assert recipe.uses_classes(recipe.teachers[0])


def test_all_kinds_are_equally_often_the_center_of_a_sample(
    dataset: tuple[PreparedDataset, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe, drawn = samples(*dataset).recipe, list[np.ndarray]()

    def record(means: np.ndarray, cameras: Cameras, center_weights: np.ndarray, *rest: Any) -> Any:
        drawn.append(center_weights)
        return choose_crop(means, cameras, center_weights, *rest)

    monkeypatch.setattr("gsencoder.train.samples.choose_crop", record)
    counts = recipe.teachers[0].class_balance.counts
    sums = np.zeros(len(counts))
    for part in dataset[0].scenes(dataset[1]):
        scene = TrainingScene([part])
        (codes,) = target_codes(scene, recipe)
        assert codes is not None
        make_sample(scene, (codes,), recipe, 200, np.random.default_rng(0))
        assert (drawn[-1][codes < 0] == 0).all()
        np.add.at(sums, codes[codes >= 0], drawn[-1][codes >= 0])
    occurring = counts > 0
    assert len(set(counts[occurring])) > 1
    np.testing.assert_allclose(sums[occurring], sums[occurring][0], rtol=1e-5)


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
        ([0.4, 0.4, 0.0, 0.0], ALL, ALL, True),
        ([0.2, 0.2, 0.0, 0.0], ALL, ALL, False),  # too faint
        ([0.0, 0.0, 0.0, 0.0], ALL, ALL, False),  # empty
        ([0.9, 0.04, 0.0, 0.0], np.array([0]), np.array([0]), True),  # 96 % inside the selection
        ([0.8, 0.1, 0.0, 0.0], np.array([0]), np.array([0]), False),  # 89 %
        ([0.4, 0.4, 0.0, 0.0], ALL, np.array([0, 2, 3]), True),  # half was left out at random
        ([0.2, 0.6, 0.0, 0.0], ALL, np.array([0, 2, 3]), False),  # too much was
    ],
)
def test_rows_stay_where_they_mean_something(
    row: list[float], selected: np.ndarray, kept: np.ndarray, stays: bool
) -> None:
    restricted = restrict_rows(rows_of([row, [1.0, 0, 0, 0]]), 4, selected, kept, LossConfig())
    assert restricted.targets.ravel().tolist() == ([0.0, 1.0] if stays else [1.0])
    assert restricted.col.max() < len(kept)


def test_cells_without_a_teachers_vector_are_left_out() -> None:
    restricted = restrict_rows(
        rows_of([[1.0, 0], [0, 1.0]], [False, True]), 2, np.arange(2), np.arange(2), LossConfig()
    )
    assert restricted.targets.ravel().tolist() == [1.0]
    assert restricted.col.tolist() == [1]


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


def test_a_dense_teacher_has_clusters_in_the_place_of_names(tmp_path: Path) -> None:
    dataset, names = prepared(tmp_path, teacher=DenseSideTeacher())
    balance = dataset.load_class_balance()
    assert dataset.load_space()[1] is None
    assert balance.counts.sum() == sum(int((scene.weights > 0).sum()) for scene in dataset.scenes(names))
    assert np.isfinite(samples(dataset, names)[0].teachers[0].targets.numpy()).all()


def test_no_scenes_are_refused(dataset: tuple[PreparedDataset, list[str]]) -> None:
    with pytest.raises(InputError, match="no scenes"):
        SampleDataset([], samples(*dataset).recipe)


def test_views_that_see_nothing_are_named(dataset: tuple[PreparedDataset, list[str]]) -> None:
    data = samples(*dataset)
    scene = data.scenes[0]
    (part,) = scene.parts
    assert part is not None
    part._header[0].cam_from_world[:, 2, 3] -= 1000  # Both cameras now stand behind the wall and look away.
    data = SampleDataset([scene], replace(data.recipe, augmentation=Augmentation()))
    with pytest.raises(InputError, match=r"scene wall_0: sample: no Gaussian"):
        data.make(0)
    # From a worker it comes back as a value, and through the batch, so that it can be raised in its own words.
    assert isinstance(data[0], InputError)
    assert isinstance(join_samples([data[0]], SMALL.transformer.patch), InputError)
    part._header[0].cam_from_world[:, 2, 3] += 1000
