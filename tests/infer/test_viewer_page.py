"""The page of `view`: its arrays hold what the scene holds, no text of it becomes markup or script, and a file holds as
much of a scene as fits."""

import base64
import gzip
import hashlib
import json
import re
import struct
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from feature_fields import plain_features
from viewed_rooms import HOSTILE, STUB, read_container, room_scene, save_viewed_room, search_of

from gsencoder.core.errors import InputError
from gsencoder.data.splats.files import load_splat
from gsencoder.infer.localize import LocalizeConfig, box_to_json, localize
from gsencoder.infer.page import page as page_module
from gsencoder.infer.page import search as module
from gsencoder.infer.page.page import (
    SCRIPT,
    STYLE,
    WORD_STEP,
    Bundle,
    Container,
    FileOptions,
    PageFile,
    file_container,
    file_page,
    fitting_page,
    jpeg_of,
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
    object_numbers,
    pca_bytes,
    spz_bytes,
    thin_for_display,
    weight_bytes,
)
from gsencoder.infer.relevancy import ThresholdConfig, feature_axes, relevancy, threshold
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


@pytest.fixture(scope="module")
def written(search: SceneSearch) -> Container:
    return read_container(file_container(search, (), OPTIONS).to_bytes())


def features_of(vectors: np.ndarray, weights: np.ndarray) -> GaussianFeatures:
    return plain_features(vectors, SPACE, weights)


def small_search(
    vectors: np.ndarray, weights: np.ndarray, config: LocalizeConfig = LocalizeConfig(), **changes: object
) -> SceneSearch:
    """A search over Gaussians with the given features; the words are the axes, and their mean is removed."""
    scene = replace(
        ROOM,
        gaussians=ROOM.gaussians.select(np.arange(len(vectors))),
        features={"names": features_of(vectors, weights)},
        **changes,  # type: ignore[arg-type]
    )
    table = replace(make_text_table(WORDS, np.eye(4, 6, dtype=np.float32), "table"), mean=np.zeros(6, np.float32))
    return SceneSearch(display=thin_for_display(scene, "few", max_gaussians=10**6), words=table, config=config)


def replace_shown(search: SceneSearch, scene: Scene, **changes: object) -> SceneSearch:
    shown = replace(search.display, scene=scene, **changes)  # type: ignore[arg-type]
    return SceneSearch(display=shown, words=search.words, config=search.config)


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


@pytest.mark.parametrize("length", [1, 8, 15])
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


def test_relevancy_from_the_arrays_of_a_page_is_that_of_the_features_within_the_budget(search, written):
    features = search.display.features
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


def test_what_a_server_answers_is_the_relevancy_in_steps(search: SceneSearch) -> None:
    table = search.words
    for name in table.names:
        exact = relevancy(search.display.features, table.encode([name]), table.mean)[0]
        answer = search.ask(name)
        seen = np.isfinite(exact)
        assert (answer.relevancy[~seen] == UNSEEN).all()
        assert np.abs(answer.relevancy[seen] * RELEVANCY_STEP - exact[seen]).max() <= RELEVANCY_STEP / 2 + 1e-6
        assert answer.threshold == pytest.approx(threshold(exact, ThresholdConfig()), abs=1e-6)


@pytest.mark.filterwarnings("ignore:.*words have no box")
def test_boxes_of_a_word_are_those_of_localize_at_any_threshold_and_a_file_has_those_of_all_words(search, written):
    for name, answer in zip(search.words.names, written.meta["answers"], strict=True):
        localization = localize(search.display.scene, [name], search.words, search.config)
        sent = search.boxes(name)
        assert sent["boxes"] == answer["boxes"] == [box_to_json(box) for box in localization.boxes]
        assert sent["probability"] == answer["probability"] == float(localization.probabilities[0])
        assert answer["threshold"] == float(localization.thresholds[0])
    assert search.boxes("mug")["boxes"]
    assert search.boxes("piano")["boxes"] == []
    assert search.boxes("piano")["probability"] < 0.02
    config = LocalizeConfig(threshold=ThresholdConfig(kind="fixed", fixed=0.9))
    expected = localize(search.display.scene, ["mug"], search.words, config)
    assert search.boxes("mug", 0.9)["boxes"] == [box_to_json(box) for box in expected.boxes]
    assert search.boxes("mug", 0.9)["boxes"] != search.boxes("mug")["boxes"]


def test_thinned_gaussians_cover_as_much_as_all_and_keep_their_weights(search: SceneSearch) -> None:
    whole = search.display
    thin = thin_for_display(whole.scene, "t", max_gaussians=1289, advice="more fits elsewhere")
    rows = np.linspace(0, len(whole.gaussians) - 1, 1289).round().astype(int)
    area = len(whole.gaussians) / 1289
    np.testing.assert_allclose(thin.gaussians.scales, whole.gaussians.scales[rows] * area**0.5, rtol=1e-5)
    np.testing.assert_array_equal(thin.features.weights, whole.features.weights[rows])
    assert f"enlarged {area**0.5:.2f} times. more fits elsewhere." in thin.notes[0]
    assert scene_container(replace_shown(search, thin.scene, total=thin.total), ()).meta["total"] == thin.total


def test_a_table_that_gaussians_share_stays_whole_where_they_are_thinned(search: SceneSearch) -> None:
    index = np.array([0, 1, 1, -1], np.int32)
    weights = np.array([1, 2, 3, 0], np.float32)
    features = replace(features_of(np.eye(2, 6), np.ones(2)), index=index, weights=weights)
    scene = replace(
        search.display.scene, gaussians=search.display.gaussians.select(np.arange(4)), features={"f": features}
    )
    thin = thin_for_display(scene, "t", max_gaussians=2).features
    assert (thin.weights.tolist(), len(thin.features)) == ([1, 0], 2)
    np.testing.assert_array_equal(thin.index, [0, -1])


def test_equal_features_have_equal_colors_others_differ_and_unseen_ones_are_grey() -> None:
    kinds = np.array([0, 1, 1, 3, 2, 1, 0, 3])
    colors = pca_bytes(features_of(np.eye(6)[kinds], kinds < 3))
    assert (colors[kinds == 3] == 90).all()
    for kind in range(3):
        assert len(np.unique(colors[kinds == kind], axis=0)) == 1
    assert len(np.unique(colors, axis=0)) == 4


def test_the_splat_of_a_page_has_the_shapes_and_colors_of_its_gaussians(tmp_path: Path) -> None:
    (tmp_path / "a.spz").write_bytes(spz_bytes(ROOM.gaussians))
    read = load_splat(tmp_path / "a.spz")
    # Logarithms of scales have steps of 1/16.
    assert np.abs(np.log(read.scales / ROOM.gaussians.scales)).max() <= 1 / 32 + 1e-5
    assert np.abs(read.sh[:, 0] - ROOM.gaussians.sh[:, 0]).max() < 0.05
    assert np.abs((read.quats * ROOM.gaussians.quats).sum(axis=1)).min() > 0.999


@pytest.mark.parametrize(
    ("weights", "codes", "ends"),
    [([0, 0], [0, 0], (1, 1)), ([3, 3], [1, 1], (3, 3)), ([0, 1, 10, 100], [0, 1, 128, 255], (1, 100))],
)
def test_weights_are_coded_by_their_logarithm_and_zero_means_never(weights, codes, ends):
    made = weight_bytes(np.array(weights, np.float32))
    np.testing.assert_array_equal(made[0], codes)
    assert made[1:] == ends


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
    scene = search.display.scene
    named = replace(ROOM.objects[0], name=None)
    made = scene_container(search, (named, *ROOM.objects[1:]))
    assert made.meta["objects"][0] == ""
    objects = (named, *ROOM.objects[1:])
    expected = object_numbers(search.display.gaussians.means, objects, scene.origin, 0.5 * search.spacing)
    np.testing.assert_array_equal(made.arrays["objects"], expected)
    far = replace_shown(search, replace(scene, origin=scene.origin + 100))
    assert not scene_container(far, objects).arrays["objects"].any()


def test_a_page_knows_the_units_the_weights_and_the_cameras_of_its_scene(search: SceneSearch) -> None:
    scene = replace(search.display.scene, metres_per_unit=0.25, origin=np.array([1.0, -2.0, 3.0]), views=ROOM.views)
    other = SceneSearch(display=replace(search.display, scene=scene), words=search.words, config=search.config)
    made = read_container(file_container(other, (), replace(OPTIONS, photographs=0)).to_bytes())
    assert made.meta["metresPerUnit"] == 0.25
    assert made.meta["origin"] == [1, -2, 3]
    assert made.meta["photographs"] is False
    assert made.meta["weights"] == list(weight_bytes(search.display.features.weights)[1:])
    assert made.meta["floor"] == feature_axes(search.display.features).floor > 0
    cameras = ROOM.views.cameras
    assert made.arrays["sizes"].tolist() == np.stack([cameras.widths, cameras.heights], axis=1).tolist()
    np.testing.assert_array_equal(made.arrays["camFromWorld"], cameras.cam_from_world)


def test_options_of_a_file_bound_harmonics_features_and_photographs(search: SceneSearch, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    scene = search.display.scene
    sh = np.concatenate([scene.gaussians.sh, 0.1 * rng.normal(size=(len(scene.gaussians), 8, 3))], axis=1)
    rich = replace_shown(
        search, replace(scene, gaussians=replace(scene.gaussians, sh=sh.astype(np.float32)), views=ROOM.views)
    )
    errors = []
    for degree, written, error in ((0, 0, 0.005), (1, 1, 0.1), (3, 2, 0.05)):
        made = file_container(rich, (), replace(OPTIONS, sh_degree=degree, error=error))
        errors.append(made.meta["featureError"])
        assert made.meta["shDegree"] == written
        (tmp_path / "a.spz").write_bytes(made.arrays["splat"].tobytes())
        assert load_splat(tmp_path / "a.spz").sh.shape[1] == (written + 1) ** 2
    assert errors[0] <= 0.005 < errors[1] <= 0.1
    sizes = made.meta["photographSizes"]
    assert len(sizes) == 3
    assert sum(sizes) == len(made.arrays["photographs"])
    assert ROOM.views.images is not None
    start = 0
    for view, size in zip(made.meta["photographViews"], sizes, strict=True):
        assert made.arrays["photographs"][start : start + size].tobytes() == jpeg_of(ROOM.views, view, 64)
        start += size


def test_labels_are_the_words_of_most_weight_and_only_of_what_is_like_them(monkeypatch: pytest.MonkeyPatch) -> None:
    axes = np.eye(6)
    unlike = axes[4] + 0.2 * axes[3]  # Most like the bowl, and not like it; heavy.
    vectors = np.stack([0 * axes[0], axes[0], axes[2], axes[1], axes[1], axes[1], unlike, axes[0] + 0.5 * axes[2]])
    weights = np.array([0, 10, 5, 1, 1, 1, 100, 1])
    none = NO_LABEL
    labels = small_search(vectors, weights).labels
    assert labels.names == ("mug", "lamp", "ball")
    assert labels.numbers.tolist() == [none, 0, 1, 2, 2, 2, none, 0]
    monkeypatch.setattr(module, "LABELS", 2)
    monkeypatch.setattr(module, "LABEL_BLOCK", 3)
    labels = small_search(vectors, weights).labels
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
    features = plain_features(inside, SPACE, weights, basis=basis)
    scene = replace(plain.display.scene, features={"names": features})
    expected = small_search(inside @ turn.T, weights).best_words([0, 1, 2, 3])
    turned = replace_shown(plain, scene).best_words([0, 1, 2, 3])
    assert [name for name, _ in turned] == [name for name, _ in expected]
    np.testing.assert_allclose([c for _, c in turned], [c for _, c in expected], atol=1e-5)


def test_a_scene_in_which_nothing_was_seen_has_no_threshold_and_no_labels() -> None:
    blind = small_search(np.zeros((4, 6)), np.zeros(4))
    answer = blind.ask("mug")
    assert answer.threshold is None
    assert blind.labels.names == ()
    assert blind.best_words([0, 1]) == []


def test_the_spacing_of_one_gaussian_is_its_size_and_another_space_is_refused() -> None:
    one = small_search(np.eye(6)[:1], np.ones(1))
    assert one.spacing == pytest.approx(np.median(one.display.gaussians.scales))
    other = make_text_table(WORDS, np.eye(4, 6, dtype=np.float32), "another encoder")
    with pytest.raises(InputError, match="use the text encoder 'table'"):
        SceneSearch(display=one.display, words=other, config=LocalizeConfig())


def test_features_without_words_are_shown_and_say_that_there_are_none(search: SceneSearch) -> None:
    features = search.display.features
    space = replace(features.space, name="dense", text_encoder="")
    scene = replace(search.display.scene, features={"dense": replace(features, space=space)})
    mute = SceneSearch(display=thin_for_display(scene, "t", max_gaussians=10**6), words=None, config=LocalizeConfig())
    with pytest.raises(InputError, match="there is no text table for these features"):
        mute.ask("mug")
    assert mute.best_words([0]) == []
    page = read_container(file_container(mute, (), OPTIONS).to_bytes())
    assert page.meta["words"] == page.meta["labels"] == []
    np.testing.assert_array_equal(page.arrays["pca"], scene_container(search, ()).arrays["pca"])


@pytest.mark.parametrize("text", [HOSTILE, "</script>", "<!--<script>", "\u2028\u2029", "\ud800", "]]>", "&lt;"])
def test_no_text_ends_the_element_that_its_json_stands_in(text: str) -> None:
    written = json_in_script({"name": text, "list": [text]})
    assert not re.search(r"[<>&\u2028\u2029\ud800]", written)
    assert json.loads(written) == {"name": text, "list": [text]}


SETTINGS = {"kind": "file", "scenes": 1, "notes": []}


AWKWARD = Bundle(script="f('</script><!-- </SCRIPT'); // é", style="body::after { content: 'é'; }")


def digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


@pytest.mark.parametrize(("served", "connect"), [(True, "'self'"), (False, "'none'")])
def test_a_page_may_run_its_own_script_alone_and_connect_to_its_server_alone(served: bool, connect: str) -> None:
    """What no policy lists is 'none'."""
    if served:
        made, policy = served_page(AWKWARD, "a", SETTINGS)
    else:
        made = file_page(AWKWARD, "a", SETTINGS, [])
    page = made.decode()
    if not served:
        match = re.search(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', page)
        policy = unescape(match[1])
    script = page[page.rindex("<script>") + len("<script>") : page.rindex("</script>")]
    style = page[page.index("<style>") + len("<style>") : page.index("</style>")]
    assert dict(part.split(" ", 1) for part in policy.split("; ")) == {
        "default-src": "'none'", "script-src": f"'sha256-{digest(script)}' 'wasm-unsafe-eval'",
        "style-src": f"'sha256-{digest(style)}'", "img-src": "blob: data:", "worker-src": "blob: data:",
        "connect-src": connect, "base-uri": "'none'", "form-action": "'none'",
    }  # fmt: skip
    assert '<meta name="referrer" content="no-referrer">' in page


def test_a_script_cannot_end_its_element() -> None:
    page = file_page(AWKWARD, "a", SETTINGS, []).decode()
    script = page[page.rindex("<script>") + len("<script>") : page.rindex("</script>")]
    assert not re.search(r"</script|<!--", script, re.IGNORECASE)
    assert page.lower().count("</script") == 2


def test_a_page_of_the_same_scene_is_the_same_whenever_it_is_written() -> None:
    page = file_page(STUB, "a", SETTINGS, [Container(meta={}, arrays={})]).decode()
    match = re.search(r'id="scene-0">([^<]+)<', page)
    # The time in the header of gzip.
    assert base64.b64decode(match[1])[4:8] == bytes(4)


@pytest.mark.parametrize("broken", [SCRIPT, STYLE])
def test_a_bundle_that_cannot_be_read_is_one_line(tmp_path: Path, broken: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (SCRIPT, STYLE):
        (tmp_path / name).mkdir() if name == broken else (tmp_path / name).write_text("")
    monkeypatch.setattr(page_module, "STATIC", tmp_path)
    with pytest.raises(InputError, match=f"{broken}.*make viewer"):
        load_bundle()


def colored(scene: Scene, degree: int) -> Scene:
    sh = np.random.default_rng(1).normal(size=(len(scene.gaussians), (degree + 1) ** 2, 3)) * 0.1
    return replace(scene, gaussians=replace(scene.gaussians, sh=sh.astype(np.float32)))


# Features within a looser error take less time.
COARSE = replace(OPTIONS, error=0.1)


def fitted(search: SceneSearch, limit: int, *degrees: int, options: FileOptions = COARSE, **further: int) -> PageFile:
    scenes = [(colored(search.display.scene, degree), f"t{degree}", search.words) for degree in degrees]
    limits = {"max_gaussians": 10**6, "max_bytes": limit} | further
    return fitting_page(STUB, scenes, LocalizeConfig(), ROOM.objects, options, **limits)


def scenes_of(made: PageFile) -> list[Container]:
    matches = re.findall(r'id="scene-\d+">([^<]+)<', made.page.decode())
    return [read_container(gzip.decompress(base64.b64decode(blob))) for blob in matches]


def test_a_page_holds_all_up_to_its_last_byte_and_says_what_it_knows(search: SceneSearch) -> None:
    whole = fitted(search, 10**7, 1)
    count = len(search.display.gaussians)
    assert [(meta["shDegree"], meta["count"]) for meta in whole.metas] == [(1, count)]
    assert whole.notes[0] == f"This file knows {len(search.words.names)} words."
    assert any("were seen by no view" in note for note in whole.notes)
    assert fitted(search, len(whole.page), 1).page == whole.page
    less = fitted(search, len(whole.page) - 1, 1)
    assert less.metas[0]["shDegree"] == 0
    assert f"larger than {(len(whole.page) - 1) / 1e6:g} MB (megabytes=) keeps them" in less.notes[0]
    (scene,) = scenes_of(whole)
    assert scene.meta["objects"] == [each.name or "" for each in ROOM.objects]
    assert scene.meta["title"] == "t1"


def test_a_thinned_page_uses_most_of_its_size_whatever_was_asked_for(search: SceneSearch) -> None:
    whole = fitted(search, 10**7, 0)
    limit = len(whole.page) // 2
    for most in (10**6, len(search.display.gaussians)):
        made = fitted(search, limit, 0, max_gaussians=most)
        assert 0.6 * limit < len(made.page) <= limit
        assert any("megabytes= or max_gaussians= takes more" in note for note in made.notes)
    tight = fitted(search, len(whole.page), 0, max_gaussians=1500)
    assert tight.metas[0]["count"] == 1500
    with pytest.raises(InputError, match="not even 1,000 Gaussians fit with the page itself, which takes 0.0 MB;"):
        fitted(search, len(whole.page) // 8, 0)
