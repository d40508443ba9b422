"""The arrays of a page, number by number: bytes of a container, thinning, colors, objects, words and settings."""

import io
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from viewed_rooms import room_scene, save_viewed_room, search_of
from viewer_containers import read_container

from gsencoder.core.errors import InputError
from gsencoder.data.splats.files import load_splat
from gsencoder.infer import presence
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.page import search as module
from gsencoder.infer.page.page import Container, FileOptions, file_container, jpeg_of, scene_container
from gsencoder.infer.page.search import (
    NO_LABEL,
    SceneSearch,
    drawn_scene,
    object_numbers,
    pca_bytes,
    rows_of_features,
    spz_bytes,
    weight_bytes,
)
from gsencoder.infer.relevancy import ThresholdConfig, feature_axes
from gsencoder.text.table import make_text_table
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures, Scene

OPTIONS = FileOptions(error=0.01, sh_degree=3, photographs=3, photograph_side=64)
ROOM = room_scene()
SPACE = FeatureSpace(name="names", channels=6, teacher="labels", text_encoder="table")
WORDS = ("mug", "ball", "lamp", "bowl")


@pytest.fixture(scope="module")
def search(tmp_path_factory: pytest.TempPathFactory) -> SceneSearch:
    made = tmp_path_factory.mktemp("arrays")
    save_viewed_room(made)
    return search_of(made / "features")


def features_of(vectors: np.ndarray, weights: np.ndarray) -> GaussianFeatures:
    return GaussianFeatures(
        features=vectors.astype(np.float32),
        weights=weights.astype(np.float32),
        mean=np.zeros(6, np.float32),
        space=SPACE,
    )


def small_search(
    vectors: np.ndarray, weights: np.ndarray, config: LocalizeConfig = LocalizeConfig(), **changes: object
) -> SceneSearch:
    """A search over Gaussians with the given features; the words are the axes, and their mean is removed."""
    assert ROOM.gaussians is not None
    scene = replace(
        ROOM,
        gaussians=ROOM.gaussians.select(np.arange(len(vectors))),
        features={"names": features_of(vectors, weights)},
        **changes,  # type: ignore[arg-type]
    )
    table = replace(make_text_table(WORDS, np.eye(4, 6, dtype=np.float32), "table"), mean=np.zeros(6, np.float32))
    return SceneSearch(shown=drawn_scene(scene, "few", max_gaussians=10**6), words=table, config=config)


@pytest.mark.parametrize("length", range(1, 18))
def test_header_and_arrays_begin_at_multiples_of_eight_bytes(length: int) -> None:
    arrays = {"first": np.arange(length, dtype=np.uint8), "second": np.arange(length, dtype=np.float32)}
    data = Container(meta={"name": "x" * length}, arrays=arrays).to_bytes()
    (header,) = struct.unpack_from("<I", data, 8)
    assert (12 + header) % 8 == 0
    listed = json.loads(data[12 : 12 + header])["arrays"]
    assert all(entry["offset"] % 8 == 0 for entry in listed.values())
    assert len(data) % 8 == 0
    for cut in (1, 4, 9):
        with pytest.raises(InputError, match="ends behind"):
            read_container(data[: 12 + header + listed["second"]["offset"] + 4 * length - cut])


def test_thinned_gaussians_cover_as_much_as_all_and_keep_their_weights(search: SceneSearch) -> None:
    whole = search.shown
    thin = drawn_scene(whole.scene, "t", max_gaussians=1289, advice="more fits elsewhere")
    rows = np.linspace(0, len(whole.gaussians) - 1, 1289).round().astype(int)
    area = len(whole.gaussians) / 1289
    np.testing.assert_allclose(thin.gaussians.scales, whole.gaussians.scales[rows] * area**0.5, rtol=1e-5)
    np.testing.assert_array_equal(thin.features.weights, whole.features.weights[rows])
    assert f"enlarged {area**0.5:.2f} times. more fits elsewhere." in thin.notes[0]
    assert scene_container(replace_shown(search, thin.scene, total=thin.total), ()).meta["total"] == thin.total


def replace_shown(search: SceneSearch, scene: Scene, **changes: object) -> SceneSearch:
    shown = replace(search.shown, scene=scene, **changes)  # type: ignore[arg-type]
    return SceneSearch(shown=shown, words=search.words, config=search.config)


def test_weights_of_rows_go_with_them_where_features_share_a_table() -> None:
    index = np.array([0, 1, 1, -1], np.int32)
    shared = GaussianFeatures(
        features=np.eye(2, 6, dtype=np.float32),
        weights=np.array([1, 2, 3, 0], np.float32),
        mean=np.zeros(6, np.float32),
        space=SPACE,
        index=index,
    )
    made = rows_of_features(shared, np.array([3, 1]))
    assert made.weights.tolist() == [0, 2]
    assert made.index is not None
    assert made.index.tolist() == [-1, 1]


def test_a_note_counts_what_was_never_seen_and_features_stand_under_the_name_of_their_space(
    search: SceneSearch,
) -> None:
    unseen = int((search.shown.features.weights == 0).sum())
    assert 0 < unseen < 1000
    assert search.shown.notes == (f"{unseen:,} Gaussians were seen by no view and have no features; they are grey.",)
    renamed = replace(search.shown.scene, features={"elsewhere": search.shown.features})
    assert list(drawn_scene(renamed, "t", max_gaussians=10).scene.features) == ["names"]


def test_equal_features_have_equal_colors_others_differ_and_unseen_ones_are_grey() -> None:
    kinds = np.array([0, 1, 1, 3, 2, 1, 0, 3])
    colors = pca_bytes(features_of(np.eye(6)[kinds], kinds < 3))
    assert (colors[kinds == 3] == 90).all()
    for kind in range(3):
        assert len(np.unique(colors[kinds == kind], axis=0)) == 1
    assert len(np.unique(colors, axis=0)) == 4


def test_the_splat_of_a_page_has_the_shapes_and_colors_of_its_gaussians(tmp_path: Path) -> None:
    assert ROOM.gaussians is not None
    (tmp_path / "a.spz").write_bytes(spz_bytes(ROOM.gaussians))
    read = load_splat(tmp_path / "a.spz")
    # Logarithms of scales have steps of 1/16.
    assert np.abs(np.log(read.scales / ROOM.gaussians.scales)).max() <= 1 / 32 + 1e-5
    assert np.abs(read.sh[:, 0] - ROOM.gaussians.sh[:, 0]).max() < 0.05
    assert np.abs((read.quats * ROOM.gaussians.quats).sum(axis=1)).min() > 0.999


def test_the_ends_of_the_weights_come_with_their_codes() -> None:
    assert weight_bytes(np.array([0, 4, 2, 8], np.float32))[1:] == (2.0, 8.0)
    assert weight_bytes(np.zeros(3, np.float32))[1:] == (1.0, 1.0)


def test_boxes_of_objects_are_in_world_coordinates_enlarged_and_the_smallest_volume_wins() -> None:
    cube = replace(ROOM.objects[-1], aabb_min=np.full(3, 99.5), aabb_max=np.full(3, 100.5))
    pole = replace(cube, aabb_min=np.array([95, 99.9, 99.9]), aabb_max=np.array([105, 100.1, 100.1]))
    means = np.array([[0, 0, 0], [0, 0.55, 0], [0, 0.65, 0], [4, 0, 0], [5.05, 0, 0], [-0.55, 0.3, -0.55]], np.float32)
    for objects, expected in (((cube, pole), [2, 1, 0, 2, 2, 1]), ((pole, cube), [1, 2, 0, 1, 1, 2])):
        made = object_numbers(means, objects, np.full(3, 100.0), 0.1)
        assert made.tolist() == expected
    with pytest.raises(InputError, match="fewer than 65,536 objects"):
        object_numbers(means[:1], [cube] * (1 << 16), np.zeros(3), 0.0)


def test_margins_of_objects_are_half_a_spacing(search: SceneSearch) -> None:
    scene = search.shown.scene
    named = replace(ROOM.objects[0], name=None)
    made = scene_container(search, (named, *ROOM.objects[1:]))
    assert made.meta["objects"][0] == ""
    objects = (named, *ROOM.objects[1:])
    expected = object_numbers(search.shown.gaussians.means, objects, scene.origin, 0.5 * search.spacing)
    np.testing.assert_array_equal(made.arrays["objects"], expected)
    far = replace_shown(search, replace(scene, origin=scene.origin + 100))
    assert not scene_container(far, objects).arrays["objects"].any()


def test_the_page_computes_with_the_settings_of_the_search(search: SceneSearch) -> None:
    limits = ThresholdConfig(kind="quantile", fixed=0.7, relative=0.4, noise=3.5, quantile=0.93)
    config = LocalizeConfig(
        min_samples=4, min_share=0.11, min_weight=0.2, max_boxes=7, min_probability=0.03, eps_spacings=2.5,
        threshold=limits,
    )  # fmt: skip
    scene = replace(search.shown.scene, metres_per_unit=0.25, origin=np.array([1.0, -2.0, 3.0]), views=ROOM.views)
    other = SceneSearch(shown=replace(search.shown, scene=scene), words=search.words, config=config)
    made = read_container(file_container(other, (), replace(OPTIONS, photographs=0)).to_bytes())
    assert made.meta["localize"] == {
        "eps": pytest.approx(2.5 * other.spacing), "followsGaps": False,
        "minSamples": 4, "minShare": 0.11, "minWeight": 0.2, "maxBoxes": 7,
        "minProbability": 0.03,
        "threshold": {"kind": "quantile", "fixed": 0.7, "relative": 0.4, "noise": 3.5, "quantile": 0.93},
    }  # fmt: skip
    assert made.meta["metresPerUnit"] == 0.25
    assert made.meta["origin"] == [1, -2, 3]
    assert made.meta["presence"] == {
        "unknown": dict(presence.WITH_RIVALS),
        "trained": dict(presence.TRAINED),
        "untrained": dict(presence.UNTRAINED),
        "smallestSpread": presence.SMALLEST_SPREAD,
    }
    assert made.meta["trained"] is None
    assert made.meta["photographs"] is False
    assert made.meta["weights"] == list(weight_bytes(search.shown.features.weights)[1:])
    assert made.meta["floor"] == feature_axes(search.shown.features).floor > 0
    assert ROOM.views is not None
    cameras = ROOM.views.cameras
    assert made.arrays["sizes"].tolist() == np.stack([cameras.widths, cameras.heights], axis=1).tolist()
    np.testing.assert_array_equal(made.arrays["camFromWorld"], cameras.cam_from_world)
    fixed = SceneSearch(shown=search.shown, words=search.words, config=LocalizeConfig(eps=0.123))
    assert scene_container(fixed, ()).meta["localize"]["eps"] == 0.123
    following = scene_container(search, ()).meta["localize"]
    assert following["followsGaps"]
    assert following["eps"] == pytest.approx(1.5 * search.spacing)


def test_a_page_knows_which_words_were_trained_and_which_are_synonyms(search: SceneSearch) -> None:
    table = search.words
    names, vectors = list(table.names), table.embeddings.copy()
    # The second word is nearly the first.
    vectors[1] = 0.95 * vectors[0] + 0.05 * vectors[1]
    vectors[1] /= np.linalg.norm(vectors[1])
    known = replace(
        make_text_table(names, vectors, "table"), mean=np.zeros_like(table.mean), trained=(names[0], names[2])
    )
    other = SceneSearch(shown=search.shown, words=known, config=search.config)
    made = file_container(other, (), OPTIONS)
    assert made.meta["synonyms"] == {"0": [0, 1], "1": [0, 1]}
    assert made.meta["trained"] == [number in (0, 2) for number in range(len(names))]


def test_options_of_a_file_bound_harmonics_features_and_photographs(search: SceneSearch, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    scene = search.shown.scene
    assert scene.gaussians is not None
    sh = np.concatenate([scene.gaussians.sh, 0.1 * rng.normal(size=(len(scene.gaussians), 8, 3))], axis=1)
    rich = replace_shown(
        search, replace(scene, gaussians=replace(scene.gaussians, sh=sh.astype(np.float32)), views=ROOM.views)
    )
    for degree, written in ((0, 0), (1, 1), (3, 2)):
        made = file_container(rich, (), replace(OPTIONS, sh_degree=degree))
        assert made.meta["shDegree"] == written
        (tmp_path / "a.spz").write_bytes(made.arrays["splat"].tobytes())
        assert load_splat(tmp_path / "a.spz").sh.shape[1] == (written + 1) ** 2
    fine, coarse = (file_container(rich, (), replace(OPTIONS, error=error)).meta for error in (0.002, 0.05))
    assert fine["featureError"] <= 0.002 < coarse["featureError"] <= 0.05
    made = file_container(rich, (), OPTIONS)
    sizes = made.meta["photographSizes"]
    assert sum(sizes) == len(made.arrays["photographs"])
    assert ROOM.views is not None
    assert ROOM.views.images is not None
    start = 0
    for view, size in zip(made.meta["photographViews"], sizes, strict=True):
        assert made.arrays["photographs"][start : start + size].tobytes() == jpeg_of(ROOM.views, view, 64)
        start += size


def test_photographs_keep_their_shape_and_nearly_their_colors() -> None:
    assert ROOM.views is not None
    assert ROOM.views.images is not None
    with Image.open(io.BytesIO(jpeg_of(ROOM.views, 2, 1000))) as picture:
        difference = np.asarray(picture, float) - ROOM.views.images[2]
    assert np.sqrt((difference**2).mean()) < 8
    for view in (-1, len(ROOM.views)):
        with pytest.raises(InputError, match=f"expected one of 6 views with photographs, got {view}"):
            jpeg_of(ROOM.views, view, 64)


def test_labels_are_the_words_of_most_weight_and_only_of_what_is_like_them(monkeypatch: pytest.MonkeyPatch) -> None:
    axes = np.eye(6)
    unlike = axes[4] + 0.2 * axes[3]  # Most like the bowl, and not like it; heavy.
    vectors = np.stack([0 * axes[0], axes[0], axes[2], axes[1], axes[1], axes[1], unlike, axes[0] + 0.5 * axes[2]])
    weights = np.array([0, 10, 5, 1, 1, 1, 100, 1])
    none = NO_LABEL
    labels = small_search(vectors, weights).labels()
    assert labels.names == ("mug", "lamp", "ball")
    assert labels.numbers.tolist() == [none, 0, 1, 2, 2, 2, none, 0]
    monkeypatch.setattr(module, "LABELS", 2)
    monkeypatch.setattr(module, "LABEL_BLOCK", 3)
    labels = small_search(vectors, weights).labels()
    assert labels.names == ("mug", "lamp")
    assert labels.numbers.tolist() == [none, 0, 1, none, none, none, none, 0]


def test_words_of_gaussians_are_weighed_and_the_same_where_features_lie_in_a_basis() -> None:
    axes = np.eye(6)
    vectors = np.stack([axes[0], axes[1], axes[1], 5 * axes[2], np.zeros(6)])
    weights = np.array([10, 1, 1, 1, 0])
    plain = small_search(vectors, weights)
    best = plain.best_words([0, 1, 2, 3, 4])
    # The mean direction is (10, 2, 1, 0, 0, 0) / 13; lengths of features do not count.
    assert [name for name, _ in best] == ["mug", "ball", "lamp", "bowl"]
    np.testing.assert_allclose([cosine for _, cosine in best], np.array([10, 2, 1, 0]) / 13, atol=1e-5)
    assert plain.best_words([4]) == []
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(6, 6)))[0][:, :5]
    basis = FeatureBasis(
        mean=np.zeros(6, np.float32), components=turn.T.astype(np.float32), energy_kept=1.0, space=SPACE
    )
    inside = vectors @ turn
    features = GaussianFeatures(
        features=inside.astype(np.float32),
        weights=weights.astype(np.float32),
        mean=np.zeros(6, np.float32),
        space=SPACE,
        basis=basis,
    )
    scene = replace(plain.shown.scene, features={"names": features})
    expected = small_search(inside @ turn.T, weights).best_words([0, 1, 2, 3])
    turned = replace_shown(plain, scene).best_words([0, 1, 2, 3])
    assert [name for name, _ in turned] == [name for name, _ in expected]
    np.testing.assert_allclose([c for _, c in turned], [c for _, c in expected], atol=1e-5)


def test_a_scene_in_which_nothing_was_seen_has_no_threshold_and_no_labels() -> None:
    blind = small_search(np.zeros((4, 6)), np.zeros(4))
    answer = blind.ask("mug")
    assert answer.threshold is None
    assert blind.labels().names == ()
    assert blind.best_words([0, 1]) == []


def test_the_threshold_of_an_answer_is_that_of_the_settings() -> None:
    config = LocalizeConfig(threshold=ThresholdConfig(kind="fixed", fixed=0.37))
    assert small_search(np.eye(6), np.ones(6), config).ask("mug").threshold == pytest.approx(0.37)


def test_the_spacing_of_one_gaussian_is_its_size_and_another_space_is_refused() -> None:
    one = small_search(np.eye(6)[:1], np.ones(1))
    assert one.spacing == pytest.approx(np.median(one.shown.gaussians.scales))
    other = make_text_table(WORDS, np.eye(4, 6, dtype=np.float32), "another encoder")
    with pytest.raises(InputError, match="use the text encoder 'table'"):
        SceneSearch(shown=one.shown, words=other, config=LocalizeConfig())
