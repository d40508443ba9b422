"""Targets of training: coordinates, cells and rows of the render loss, and which Gaussian has which."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pretend_device import pretended_device
from training_scenes import PREPARE, TABLE, DenseSideTeacher, SideTeacher, prepared, samples, scene

from gsencoder.fusion.fuse import FuseConfig
from gsencoder.train.prepare import prepare_scene
from gsencoder.train.prepared_file import PreparedScene
from gsencoder.train.samples import SamplingConfig
from gsencoder.train.space import dataset_space
from gsencoder.types import FeatureMap, Views


@pytest.mark.parametrize("teacher", [SideTeacher(), DenseSideTeacher()], ids=["coded", "dense"])
@pytest.mark.parametrize(("center", "scale"), [(True, True), (True, False), (False, True), (False, False)])
def test_targets_are_centered_and_scaled_only_where_that_is_asked(
    teacher: SideTeacher, center: bool, scale: bool
) -> None:
    config = FuseConfig(basis=False)
    made = dataset_space([Path("a")], lambda path: (scene(0), teacher), config, views=2, center=center, scale=scale)
    outputs = made.outputs
    expected = (TABLE - (outputs.mean if center else 0)) / (outputs.scale / 2 if scale else 1)
    np.testing.assert_allclose(outputs.standardize(TABLE), expected, atol=1e-5)
    if made.codebook is not None:
        order = np.lexsort(TABLE.T[::-1])
        np.testing.assert_allclose(made.codebook, expected[order], atol=1e-5)


@pytest.mark.parametrize("teacher", [SideTeacher(), DenseSideTeacher()], ids=["coded", "dense"])
def test_a_scene_that_is_prepared_on_another_device_is_the_same_within_rounding(
    tmp_path: Path, teacher: SideTeacher
) -> None:
    dataset, _ = prepared(tmp_path, count=1)
    outputs = dataset.load_space()[0]
    prepare_scene(tmp_path / "cpu.safetensors", scene(0), teacher, outputs, PREPARE)
    with pretended_device() as device:
        prepare_scene(tmp_path / "device.safetensors", scene(0), teacher, outputs, PREPARE, device=device)
    here, there = PreparedScene(tmp_path / "cpu.safetensors"), PreparedScene(tmp_path / "device.safetensors")
    rows = np.arange(len(here))
    np.testing.assert_allclose(there.weights, here.weights, rtol=1e-4, atol=1e-4)
    seen = np.asarray(here.weights) > 1e-3
    np.testing.assert_allclose(there.targets(rows)[seen], here.targets(rows)[seen], atol=2e-3)
    for view in range(2):
        one, other = here.view(view), there.view(view)
        np.testing.assert_array_equal(other.crow, one.crow)
        np.testing.assert_array_equal(other.col, one.col)
        np.testing.assert_allclose(other.weight, one.weight, atol=2e-4)  # They are stored as float16.


def test_faint_weights_are_left_out_of_the_rows_of_the_render_loss(tmp_path: Path) -> None:
    dataset, _ = prepared(tmp_path, count=1)
    outputs, weights = dataset.load_space()[0], {}
    for least in (0.0, 0.0625):
        path = tmp_path / f"least_{least}.safetensors"
        prepare_scene(path, scene(0), SideTeacher(), outputs, replace(PREPARE, render_min_weight=least))
        weights[least] = PreparedScene(path).view(0).weight
    assert 0 < weights[0.0].min() < 0.0625 <= weights[0.0625].min()
    assert 0 < len(weights[0.0625]) < len(weights[0.0])


def test_cells_of_the_render_loss_that_a_mask_cuts_are_not_valid(tmp_path: Path) -> None:
    dataset, _ = prepared(tmp_path, count=1)
    masked = scene(0)
    assert masked.views is not None
    # Of 48 × 40 pixels in cells of 4, the first two columns of cells and half of the third are masked.
    mask = np.broadcast_to(np.arange(48) >= 10, (40, 48)).copy()
    masked = replace(masked, views=replace(masked.views, masks=[mask, np.ones((40, 48), bool)]))
    path = tmp_path / "masked.safetensors"
    prepare_scene(path, masked, SideTeacher(), dataset.load_space()[0], PREPARE)
    np.testing.assert_array_equal(PreparedScene(path).view(0).valid.reshape(10, 12).sum(axis=0), [0] * 3 + [10] * 9)
    assert PreparedScene(path).view(1).valid.all()


class CornerTeacher(SideTeacher):
    """Says of the lower third of the left half of a picture that it is one thing, and of the rest another."""

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        height, width = int(views.cameras.heights[view]), int(views.cameras.widths[view])
        codes = np.full((height, width), 2, np.int32)
        codes[height - 12 :, : width // 2] = 1
        return FeatureMap(
            codes=codes, table=TABLE, grid_from_image=np.array([[1.0, 0, 0], [0, 1.0, 0]]), space=self.space
        )


def test_cells_of_the_render_loss_lie_where_their_pixels_do(tmp_path: Path) -> None:
    dataset, _ = prepared(tmp_path, count=1)
    outputs, path = dataset.load_space()[0], tmp_path / "corner.safetensors"
    prepare_scene(path, scene(0), CornerTeacher(), outputs, PREPARE)
    vectors = outputs.restore(PreparedScene(path).view(0).targets).reshape(10, 12, 4)
    expected = np.broadcast_to(TABLE[2], (10, 12, 4)).copy()
    expected[7:, :6] = TABLE[1]
    np.testing.assert_allclose(vectors, expected, atol=5e-3)


def test_gaussians_that_are_left_after_dropping_keep_their_own_targets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, names = prepared(tmp_path, count=1)
    monkeypatch.setattr("gsencoder.train.samples.drop_random", lambda rows, share, rng: rows[1::3])
    data = samples(dataset, names, sampling=SamplingConfig(views=2, gaussians=0, scope="scene"))
    (part,) = dataset.scenes(names)
    rows, sample = np.arange(len(part))[1::3], data.make(0)
    (own,) = sample.teachers
    assert len(sample.attributes) == len(rows)
    targets, balance = part.targets(rows), data.recipe.teachers[0].class_balance
    np.testing.assert_array_equal(own.targets.numpy(), targets)
    weights = np.where(part.weights[rows] > 0, balance.target_weights(targets, data.recipe.losses.rarity), 0)
    np.testing.assert_allclose(own.loss_weights.numpy(), weights, rtol=1e-6)
    # The side of the wall that a Gaussian is on shows in its color, and in its target.
    far = np.abs(part.means[rows, 0]) > 0.3
    red = part.gaussians(rows).sh[:, 0, 0] > 0
    np.testing.assert_array_equal(own.targets.numpy()[far, 0] > own.targets.numpy()[far, 1], red[far])
