"""What the types that pass between stages do beside holding arrays."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from splats import random_gaussians

from gsencoder.core.errors import InputError
from gsencoder.types import Cameras, FeatureBasis, FeatureMap, FeatureSpace, GaussianFeatures, Scene, Views


def camera(width: int, height: int) -> Cameras:
    K = np.array([[[0.7 * width, 0, 0.45 * width], [0, 0.7 * width, 0.55 * height], [0, 0, 1]]], np.float32)
    return Cameras(
        cam_from_world=np.eye(4, dtype=np.float32)[None], Ks=K, widths=np.array([width], np.int32),
        heights=np.array([height], np.int32),
    )  # fmt: skip


@pytest.mark.parametrize(("width", "height", "longest"), [(640, 480, 160), (97, 231, 50), (64, 48, 640), (1000, 1, 8)])
def test_resized_cameras_keep_their_field_of_view(width, height, longest):
    whole = camera(width, height)
    small = whole.resized(longest)
    assert max(small.widths[0], small.heights[0]) == longest
    assert min(small.widths[0], small.heights[0]) >= 1
    corners = np.array([[0.0, 0, 1], [width, height, 1]])
    scaled = corners * (small.widths[0] / width, small.heights[0] / height, 1)
    rays = np.linalg.solve(whole.Ks[0].astype(np.float64), corners.T)
    np.testing.assert_allclose(np.linalg.solve(small.Ks[0].astype(np.float64), scaled.T), rays, atol=1e-6)
    assert (small.cam_from_world == whole.cam_from_world).all()


@pytest.mark.parametrize("unit", [0.0, -1.0, float("nan"), float("inf"), 10**400, True, "1"])
def test_a_scene_has_a_positive_unit_or_none(unit, no_jaxtyping):
    with pytest.raises(InputError, match=r"Scene\.metres_per_unit: expected a positive number of metres"):
        Scene(name="room", metres_per_unit=unit)


@pytest.mark.parametrize("means", [None, [[0.0, 0, 0]], np.zeros((), np.float32), np.zeros(3, np.float32)])
def test_means_that_are_no_rows_are_refused(means, no_jaxtyping):
    with pytest.raises(InputError, match=r"Gaussians\.means: expected"):
        replace(random_gaussians(1), means=means)


def test_views_need_a_name_and_an_entry_for_each_camera(no_jaxtyping):
    two = camera(8, 6).select([0, 0])
    with pytest.raises(InputError, match=r"Views\.names: expected 2 names, one a camera, got 1"):
        Views(cameras=two, names=("a",))
    with pytest.raises(InputError, match=r"Views\.names: expected unique names, got 1 repeated"):
        Views(cameras=two, names=("a", "a"))
    for field in ("images", "depths", "masks", "instances"):
        with pytest.raises(InputError, match=rf"Views\.{field}: expected 2 entries, one a camera, got 1"):
            Views(cameras=two, names=("a", "b"), **{field: [np.zeros((6, 8))]})
    assert len(Views(cameras=two, names=("a", "b"))) == 2


def test_selected_views_have_all_that_belongs_to_them_also_by_slices_and_from_the_end():
    cameras = camera(8, 6).select([0, 0, 0, 0])
    kinds = {"images": np.uint8, "depths": np.float32, "masks": bool, "instances": np.int32}
    entries = {
        name: [np.full((6, 8, 3) if name == "images" else (6, 8), view % 2 if kind is bool else view, kind)
               for view in range(4)]
        for name, kind in kinds.items()
    }  # fmt: skip
    chosen = Views(cameras=cameras, names=tuple("abcd"), **entries).select([3, 1, 2])
    assert len(chosen) == 3
    for name in kinds:
        items = getattr(chosen, name)
        assert len(items) == 3
        for row, view in enumerate((3, 1, 2)):
            np.testing.assert_array_equal(items[row], entries[name][view])
        np.testing.assert_array_equal(items[-1], entries[name][2])
        assert [item.max() for item in items[::-2]] == [item.max() for item in (entries[name][2], entries[name][3])]
        with pytest.raises(IndexError):
            items[3]
    assert Views(cameras=cameras, names=tuple("abcd")).select([]).names == ()


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "a\0b"])
def test_the_name_of_a_scene_can_be_that_of_a_folder(name):
    with pytest.raises(InputError, match=r"Scene\.name: expected a name that a folder can have"):
        Scene(name=name)


def test_up_and_origin_of_a_scene_are_three_float64(no_jaxtyping):
    for up in (np.array([0.0, 0, 1.01]), np.array([0.0, 0.98, 0]), np.array([0.0, 1.0]), np.array([0, 1, 0])):
        with pytest.raises(InputError, match=r"Scene\.up"):
            Scene(name="a", up=up)
    for origin in (np.array([0.0, np.inf, 0]), np.zeros(4), np.zeros(3, np.float32)):
        with pytest.raises(InputError, match=r"Scene\.origin"):
            Scene(name="a", origin=origin)
    assert Scene(name="..a", up=np.array([0.0, 0.6, 0.8])).origin.tolist() == [0, 0, 0]


def test_features_lie_on_the_gaussians_of_their_scene():
    space = FeatureSpace(name="a", channels=2)
    features = GaussianFeatures(
        features=np.zeros((5, 2), np.float32), weights=np.ones(5, np.float32), mean=np.zeros(2, np.float32), space=space
    )
    Scene(name="a", gaussians=random_gaussians(5), features={"a": features})
    for gaussians, got in ((None, "no Gaussians"), (random_gaussians(4), "4 Gaussians")):
        with pytest.raises(InputError, match=rf"Scene\.features\['a'\]: expected 5 Gaussians to lie on, got {got}"):
            Scene(name="a", gaussians=gaussians, features={"a": features})


GRID: dict[str, Any] = {"grid_from_image": np.eye(2, 3), "space": FeatureSpace(name="a", channels=2)}
TABLE = np.eye(3, 2, dtype=np.float32)


def test_a_space_has_one_channel_or_more():
    assert FeatureSpace(name="a", channels=1).channels == 1
    with pytest.raises(InputError, match="channels"):
        FeatureSpace(name="a", channels=0)


def test_a_map_is_in_one_form_and_knows_its_size():
    features, codes = np.zeros((3, 4, 2), np.float32), np.array([[-1, 0, 1, 2]] * 3, np.int32)
    shares = np.zeros((3, 4, 3), np.float32)
    shares[0, 0] = (0, 2, 1e30)
    maps = [
        FeatureMap(features=features, **GRID),
        FeatureMap(codes=codes, table=TABLE, **GRID),
        FeatureMap(shares=shares, table=TABLE, **GRID),
    ]
    assert [(each.height, each.width) for each in maps] == [(3, 4)] * 3
    forms: list[dict[str, Any]] = [
        {}, {"table": TABLE}, {"features": features, "table": TABLE}, {"features": features, "shares": shares},
        {"codes": codes}, {"codes": codes, "shares": shares, "table": TABLE},
    ]  # fmt: skip
    for form in forms:
        with pytest.raises(InputError, match="expected features, or codes or shares with their table"):
            FeatureMap(**form, **GRID)


@pytest.mark.parametrize("value", [-1e-6, float("nan"), float("inf")])
def test_shares_are_finite_and_not_negative(value):
    shares = np.ones((3, 4, 3), np.float32)
    shares[1, 2, 0] = value
    with pytest.raises(InputError, match=r"FeatureMap\.shares: expected finite shares from 0"):
        FeatureMap(shares=shares, table=TABLE, **GRID)


def test_codes_and_shares_belong_to_rows_of_their_table_and_those_to_the_space(no_jaxtyping):
    with pytest.raises(InputError, match=r"shares: expected 3 columns, got 4"):
        FeatureMap(shares=np.ones((3, 5, 4), np.float32), table=TABLE, **GRID)
    for wrong in (-2, 3):
        with pytest.raises(InputError, match=r"codes: expected -1 to 2, got"):
            FeatureMap(codes=np.array([[0, wrong]], np.int32), table=TABLE, **GRID)
    with pytest.raises(InputError, match=r"features: expected 2 channels \(a\), got 3"):
        FeatureMap(shares=np.ones((3, 4, 3), np.float32), table=np.eye(3, dtype=np.float32), **GRID)
    with pytest.raises(InputError, match=r"features: expected 2 channels \(a\), got 5"):
        FeatureMap(features=np.ones((3, 4, 5), np.float32), **GRID)


def test_features_and_their_mean_are_arrays_of_the_space_with_finite_weights(no_jaxtyping):
    good = {name: np.zeros(shape, np.float32) for name, shape in (("features", (3, 2)), ("weights", 3), ("mean", 2))}
    assert not GaussianFeatures(**good, space=GRID["space"]).seen.any()
    for name, value in (
        ("features", np.zeros((3, 3), np.float32)),
        ("features", np.zeros((3, 2))),
        ("features", np.full((3, 2), np.nan, np.float32)),
        ("weights", np.zeros(2, np.float32)),
        ("weights", np.array([0, 1, np.inf], np.float32)),
        ("weights", np.array([0, 1, -1], np.float32)),
        ("mean", np.zeros(3, np.float32)),
        ("mean", np.array([0, np.nan], np.float32)),
    ):
        with pytest.raises(InputError, match=rf"GaussianFeatures\.{name}"):
            GaussianFeatures(**{**good, name: value}, space=GRID["space"])


def test_an_index_numbers_the_rows_of_a_table_where_gaussians_were_seen(no_jaxtyping):
    table = np.arange(6, dtype=np.float32).reshape(3, 2)
    weights = np.array([1, 0, 2, 3], np.float32)
    good = {"features": table, "weights": weights, "mean": np.zeros(2, np.float32), "space": GRID["space"]}
    features = GaussianFeatures(**good, index=np.array([2, -1, 0, 2], np.int32))
    assert len(features) == 4
    np.testing.assert_array_equal(features.stored(), [[4, 5], [0, 0], [0, 1], [4, 5]])
    np.testing.assert_array_equal(features.decode(np.array([3, 1])), [[4, 5], [0, 0]])
    np.testing.assert_array_equal(table, np.arange(6).reshape(3, 2))
    for index in ([3, -1, 0, 2], [2, 0, 0, 2], [-1, -1, 0, 2], [2, -2, 0, 2], [2, -1, 0]):
        with pytest.raises(InputError, match=r"GaussianFeatures\.(index|weights)"):
            GaussianFeatures(**good, index=np.array(index, np.int32))
    with pytest.raises(InputError, match=r"GaussianFeatures\.index"):
        GaussianFeatures(**good, index=np.array([2, -1, 0, 2], np.int64))


def test_a_basis_keeps_between_nothing_and_all_of_the_energy():
    def basis(energy: float) -> FeatureBasis:
        rows, mean = np.eye(1, 2, dtype=np.float32), np.zeros(2, np.float32)
        return FeatureBasis(mean=mean, components=rows, energy_kept=energy, space=GRID["space"])

    # Sums are rounded.
    assert [basis(energy).rank for energy in (0.0, 0.5, 1.0, 1 + 1e-7)] == [1] * 4
    for energy in (-1e-9, 1.01, float("nan")):
        with pytest.raises(InputError, match=r"FeatureBasis\.energy_kept: expected a share in \[0, 1\]"):
            basis(energy)
