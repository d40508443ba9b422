"""The page of `view`: its arrays hold what the scene holds, and no text of a scene becomes markup or script."""

import base64
import gzip
import io
import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from viewed_rooms import HOSTILE, STUB, name_features, room_scene, save_viewed_room, search_of
from viewer_containers import read_container

from gsencoder.core.errors import InputError
from gsencoder.data.splats.files import load_splat
from gsencoder.fusion.quantize import compact
from gsencoder.infer.localize import LocalizeConfig, localize
from gsencoder.infer.page.page import (
    WORD_STEP,
    Container,
    FileOptions,
    MadePage,
    file_container,
    file_page,
    fitting_page,
    json_in_script,
    load_bundle,
    scene_container,
    served_page,
)
from gsencoder.infer.page.search import (
    NO_LABEL,
    RELEVANCY_STEP,
    UNSEEN,
    SceneSearch,
    drawn_scene,
    object_numbers,
    rows_of_features,
    spz_bytes,
    weight_bytes,
)
from gsencoder.infer.relevancy import ThresholdConfig, relevancy, threshold
from gsencoder.types import Scene

OPTIONS = FileOptions(error=0.01, sh_degree=3, photographs=2, photograph_side=64)
room = cache(room_scene)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("viewed")
    save_viewed_room(made)
    return made / "features"


@pytest.fixture(scope="module")
def search(folder: Path) -> SceneSearch:
    return search_of(folder)


@pytest.fixture(scope="module")
def written(search: SceneSearch) -> Container:
    return read_container(file_container(search, (), OPTIONS).to_bytes())


def cosines_of_page(page: Container, word: int) -> np.ndarray:
    """What the script computes from the arrays of a page, in numpy."""
    meta, arrays = page.meta, page.arrays
    bits, levels = arrays["bits"].astype(int), arrays["levels"]
    seen = np.unpackbits(arrays["seen"], count=meta["count"]).astype(bool)
    ones = np.unpackbits(arrays["codes"].reshape(seen.sum(), -1), axis=1)
    coordinates = np.zeros((seen.sum(), meta["rank"]), np.float32)
    bit = level = 0
    for column, width in enumerate(bits):
        code = ones[:, bit : bit + width] @ (1 << np.arange(width)[::-1])
        coordinates[:, column] = levels[level + code]
        bit, level = bit + width, level + (1 << width)
    vector = arrays["wordVectors"].reshape(-1, meta["rank"])[word] * WORD_STEP
    cosines = np.full(meta["count"], np.nan)
    cosines[seen] = coordinates @ vector / np.sqrt((coordinates**2).sum(axis=1) + meta["floor"])
    return cosines


def test_a_container_is_read_as_it_was_written(rng: np.random.Generator) -> None:
    arrays = {
        "empty": np.zeros((0, 3), np.float32),
        "one": np.array([7], np.uint8),
        "steps": rng.integers(-300, 300, (5, 2)).astype(np.int16),
        "values": rng.normal(size=(3, 4)).astype(np.float32),
        "turned": np.arange(6, dtype=np.int32).reshape(2, 3).T,
    }
    meta = {"name": HOSTILE, "none": None, "lost": float("nan"), "lone": "\ud800"}
    read = read_container(Container(meta=meta, arrays=arrays).to_bytes())
    assert read.meta == {**meta, "lost": None}
    for name, array in arrays.items():
        assert read.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(read.arrays[name], array)


@pytest.mark.parametrize("data", [b"", b"GSVIEW01", b"something else entirely"])
def test_other_bytes_are_no_container(data: bytes) -> None:
    with pytest.raises(InputError, match="begin with"):
        read_container(data)


def test_a_container_that_is_cut_off_is_refused() -> None:
    whole = Container(meta={}, arrays={"a": np.arange(100, dtype=np.uint8)}).to_bytes()
    with pytest.raises(InputError, match="ends behind"):
        read_container(whole[:-50])


def test_float64_has_no_place_in_a_container() -> None:
    with pytest.raises(InputError, match="float64"):
        Container(meta={}, arrays={"a": np.zeros(1)}).to_bytes()


def test_relevancy_from_the_arrays_of_a_page_is_that_of_the_features_within_the_budget(
    search: SceneSearch, written: Container
) -> None:
    features = search.shown.features
    table = search.words
    budget = written.meta["featureError"]
    assert 0 < budget <= OPTIONS.error
    for word, name in enumerate(table.names):
        exact = relevancy(features, table.encode([name]), table.mean)[0]
        page = cosines_of_page(written, word)
        np.testing.assert_array_equal(np.isnan(page), np.isnan(exact))
        difference = np.abs(page - exact)[np.isfinite(exact)]
        # Of unit vectors u, v, t with 1 − u·v = e, |u·t − v·t| is at most √(2e), for the mean row as for any.
        assert np.sqrt(np.mean(difference**2)) <= np.sqrt(2 * budget) + 1e-4


def test_words_of_a_page_lose_no_more_than_their_rounding(search: SceneSearch, written: Container) -> None:
    quantized = compact(search.shown.features, error=OPTIONS.error).features()
    for word, name in enumerate(search.words.names):
        exact = relevancy(quantized, search.words.encode([name]), search.words.mean)[0]
        np.testing.assert_allclose(cosines_of_page(written, word), exact, atol=1e-4)


def test_a_page_orders_boxes_of_a_word_as_localize_does(search: SceneSearch, written: Container) -> None:
    localization = localize(search.shown.scene, ["mug"], search.words, search.config)
    page = cosines_of_page(written, written.meta["words"].index("mug"))
    rows = np.concatenate([box.rows for box in localization.boxes])
    assert len(rows)
    assert (page[rows] >= localization.thresholds[0] - 0.1).all()


def test_what_a_server_answers_is_the_relevancy_in_steps(search: SceneSearch) -> None:
    table = search.words
    for name in table.names:
        exact = relevancy(search.shown.features, table.encode([name]), table.mean)[0]
        answer = search.ask(name)
        seen = np.isfinite(exact)
        assert (answer.relevancy[~seen] == UNSEEN).all()
        assert np.abs(answer.relevancy[seen] * RELEVANCY_STEP - exact[seen]).max() <= RELEVANCY_STEP / 2 + 1e-6
        assert answer.threshold == pytest.approx(threshold(exact, ThresholdConfig()), abs=1e-6)


def test_boxes_of_a_server_are_those_of_localize(search: SceneSearch) -> None:
    localization = localize(search.shown.scene, ["mug"], search.words, search.config)
    sent = search.boxes("mug")
    assert [box["score"] for box in sent["boxes"]] == [box.score for box in localization.boxes]
    assert sent["probability"] == pytest.approx(float(localization.probabilities[0]))
    assert search.boxes("piano")["boxes"] == []
    assert search.boxes("piano")["probability"] < 0.02


def test_the_words_of_gaussians_are_those_of_their_object(search: SceneSearch) -> None:
    rows = localize(search.shown.scene, ["mug"], search.words, search.config).boxes[0].rows
    assert search.best_words(rows.tolist())[0][0] == "mug"
    assert search.best_words([int(rows[0])])[0][0] == "mug"
    unseen = np.flatnonzero(~search.shown.features.seen)
    assert search.best_words(unseen[:3].tolist()) == []


def test_labels_name_what_gaussians_are_and_nothing_that_was_not_seen(search: SceneSearch) -> None:
    labels = search.labels()
    seen = search.shown.features.seen
    assert (labels.numbers[~seen] == NO_LABEL).all()
    rows = localize(search.shown.scene, ["mug"], search.words, search.config).boxes[0].rows
    names = {labels.names[number] for number in labels.numbers[rows] if number != NO_LABEL}
    assert names == {"mug"}


def test_the_splat_of_a_page_keeps_the_order_and_places_of_its_rows(search: SceneSearch, tmp_path: Path) -> None:
    gaussians = search.shown.gaussians
    (tmp_path / "a.spz").write_bytes(spz_bytes(gaussians))
    read = load_splat(tmp_path / "a.spz")
    assert np.abs(read.means - gaussians.means).max() < 1e-3
    assert np.abs(read.opacities - gaussians.opacities).max() <= 1 / 510 + 1e-6


def test_harmonics_above_a_degree_are_left_out(tmp_path: Path, rng: np.random.Generator) -> None:
    scene = room()
    assert scene.gaussians is not None
    few = scene.gaussians.select(np.arange(20))
    full = replace(few, sh=(0.1 * rng.normal(size=(20, 16, 3))).astype(np.float32))
    for degree, coefficients in ((0, 1), (1, 4), (3, 16)):
        (tmp_path / "a.spz").write_bytes(spz_bytes(full, sh_degree=degree))
        assert load_splat(tmp_path / "a.spz").sh.shape[1] == coefficients


def test_thinned_scenes_say_so_and_keep_features_with_their_gaussians(search: SceneSearch) -> None:
    scene = search.shown.scene
    thin = drawn_scene(scene, "t", max_gaussians=500)
    assert len(thin.gaussians) == len(thin.features) == 500
    assert thin.total == len(search.shown.gaussians)
    assert "500 of" in thin.notes[0]
    assert "max_gaussians=" in thin.notes[0]
    places = {tuple(mean): row for row, mean in enumerate(search.shown.gaussians.means.tolist())}
    rows = [places[tuple(mean)] for mean in thin.gaussians.means.tolist()]
    np.testing.assert_array_equal(thin.features.features, search.shown.features.features[rows])


def test_a_scene_that_is_not_thinned_is_left_as_it_is(search: SceneSearch) -> None:
    count = len(search.shown.gaussians)
    whole = drawn_scene(search.shown.scene, "t", max_gaussians=count)
    assert whole.gaussians is search.shown.gaussians


def test_features_that_share_a_table_keep_it() -> None:
    features, _ = name_features(room())
    index = np.where(features.seen, np.arange(len(features)) % 7, -1).astype(np.int32)
    shared = replace(features, features=features.features[:7], index=index)
    rows = np.array([5, 900, 17])
    np.testing.assert_array_equal(rows_of_features(shared, rows).stored(), shared.stored(rows))


@pytest.mark.parametrize(
    ("weights", "codes"),
    [([0, 0], [0, 0]), ([3, 3], [1, 1]), ([0, 1, 100], [0, 1, 255]), ([0, 1, 10, 100], [0, 1, 128, 255])],
)
def test_weights_are_coded_by_their_logarithm_and_zero_means_never(weights: list[float], codes: list[int]) -> None:
    np.testing.assert_array_equal(weight_bytes(np.array(weights, np.float32))[0], codes)


def test_a_gaussian_belongs_to_the_smallest_object_around_it() -> None:
    scene = room()
    inner = replace(scene.objects[-1], aabb_min=np.full(3, -0.1), aabb_max=np.full(3, 0.1))
    outer = replace(inner, aabb_min=np.full(3, -1.0), aabb_max=np.full(3, 1.0))
    means = np.array([[0, 0, 0], [0.5, 0, 0], [2, 0, 0]], np.float32)
    np.testing.assert_array_equal(object_numbers(means, (inner, outer), np.zeros(3), 0.0), [1, 2, 0])
    np.testing.assert_array_equal(object_numbers(means, (outer, inner), np.zeros(3), 0.0), [2, 1, 0])


@pytest.mark.parametrize("text", [HOSTILE, "</script>", "<!--<script>", "\u2028\u2029", "\ud800", "]]>", "&lt;"])
def test_no_text_ends_the_element_that_its_json_stands_in(text: str) -> None:
    written = json_in_script({"name": text, "list": [text]})
    assert not re.search(r"[<>&\u2028\u2029\ud800]", written)
    assert json.loads(written) == {"name": text, "list": [text]}


def test_titles_are_escaped_and_scripts_are_bound_to_their_sum() -> None:
    page, policy = served_page(STUB, HOSTILE, {"kind": "server", "scenes": 1, "notes": [HOSTILE]})
    text = page.decode("utf-8")
    assert text.count("<script") == 2
    assert "<img" not in text
    assert "'unsafe-inline'" not in policy
    assert "default-src 'none'" in policy


def test_a_page_of_a_file_holds_its_scenes_and_loads_nothing(written: Container, search: SceneSearch) -> None:
    container = file_container(search, (), OPTIONS)
    page = file_page(STUB, "a", {"kind": "file", "scenes": 1, "notes": []}, [container]).decode("utf-8")
    packed = re.search(r'id="scene-0">([A-Za-z0-9+/=]+)</script>', page)
    assert packed is not None
    read = read_container(gzip.decompress(base64.b64decode(packed[1])))
    assert read.meta == written.meta
    assert "connect-src 'none';" in page.replace("&#x27;", "'")
    assert not re.search(r"(src|href)=\"?https?:", page)


def test_photographs_of_a_file_are_small_and_say_whose_they_are(search: SceneSearch) -> None:
    scene = room()
    shown = replace(search.shown, scene=replace(search.shown.scene, views=scene.views))
    container = file_container(replace_shown(search, shown.scene), (), OPTIONS)
    assert container.meta["photographViews"] == [0, 5]
    first = container.arrays["photographs"][: container.meta["photographSizes"][0]].tobytes()
    with Image.open(io.BytesIO(first)) as picture:
        assert picture.size == (64, 48)


def replace_shown(search: SceneSearch, scene: Scene) -> SceneSearch:
    shown = drawn_scene(scene, "features", max_gaussians=1_000_000)
    return SceneSearch(shown=shown, words=search.words, config=search.config)


def test_objects_come_with_numbers_and_names(search: SceneSearch) -> None:
    scene = room()
    container = scene_container(search, scene.objects)
    assert container.meta["objects"] == [each.name or "" for each in scene.objects]
    assert container.arrays["objects"].max() <= len(scene.objects)
    assert "objects" not in scene_container(search, ()).arrays


def test_a_page_that_is_too_large_loses_harmonics_then_gaussians_and_says_so(search: SceneSearch) -> None:
    rng = np.random.default_rng(0)
    scene = search.shown.scene
    assert scene.gaussians is not None
    sh = np.concatenate([scene.gaussians.sh, rng.normal(size=(len(scene.gaussians), 8, 3))], axis=1).astype(np.float32)
    colored = replace(scene, gaussians=replace(scene.gaussians, sh=0.1 * sh))

    def fitting(limit: int) -> MadePage:
        made = fitting_page(
            STUB, [(colored, "t", search.words)], LocalizeConfig(), (), OPTIONS, max_gaussians=10**6, max_bytes=limit
        )
        assert len(made.page) <= limit
        return made

    whole = fitting(10**7)
    assert whole.sh_degree == (2,)
    assert not any("harmonics" in note for note in whole.notes)
    fewer = fitting(len(whole.page) - 1)
    assert fewer.sh_degree == (1,)
    assert any("above degree 1 of 2" in note for note in fewer.notes)
    thinned = fitting(len(whole.page) // 4)
    assert thinned.sh_degree == (0,)
    assert thinned.gaussians < whole.gaussians
    assert any("Gaussians are drawn" in note for note in thinned.notes)
    with pytest.raises(InputError, match="not even"):
        fitting(10_000)


def test_a_threshold_that_pages_do_not_compute_is_refused(search: SceneSearch) -> None:
    config = LocalizeConfig(threshold=ThresholdConfig(kind="otsu"))
    with pytest.raises(InputError, match="otsu"):
        file_container(SceneSearch(shown=search.shown, words=search.words, config=config), (), OPTIONS)


def test_features_without_words_are_shown_and_say_that_none_lead_into_them(search: SceneSearch) -> None:
    features = search.shown.features
    space = replace(features.space, name="dense", text_encoder="")
    scene = replace(search.shown.scene, features={"dense": replace(features, space=space)})
    mute = SceneSearch(shown=drawn_scene(scene, "t", max_gaussians=10**6), words=None, config=LocalizeConfig())
    with pytest.raises(InputError, match="no words lead into"):
        mute.ask("mug")
    assert mute.best_words([0]) == []
    page = read_container(file_container(mute, (), OPTIONS).to_bytes())
    assert page.meta["words"] == page.meta["labels"] == []
    np.testing.assert_array_equal(page.arrays["pca"], scene_container(search, ()).arrays["pca"])


def test_a_bundle_that_was_not_built_is_one_line_that_says_how(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="make viewer"):
        load_bundle(tmp_path)
