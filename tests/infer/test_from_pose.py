"""Words to points from a pose: beside the plain definition in float64, in moved worlds, at the ends of the range."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation
from splats import front_camera, one_gaussian, random_gaussians, random_rotation

from gsencoder.core.errors import InputError
from gsencoder.infer.draw.pose_pictures import pose_picture, view_picture
from gsencoder.infer.localize.from_pose import MAX_RAYS, FeatureField, FromPoseConfig, PosePoint, from_pose
from gsencoder.infer.localize.relevancy import relevancy, word_directions
from gsencoder.infer.localize.threshold import ThresholdConfig
from gsencoder.memory.render import render_features
from gsencoder.render import blend
from gsencoder.text.table import TextTable, make_text_table
from gsencoder.types import (
    Cameras,
    FeatureBasis,
    FeatureSpace,
    GaussianFeatures,
    Gaussians,
    MemoryBank,
    QueryMemory,
    Scene,
)

CHANNELS = 40
SPACE = FeatureSpace(name="toy", channels=CHANNELS, text_encoder="toy")
NAMES = tuple(f"word {letter}" for letter in "abcdefghijklmnopqrst")
EVERYTHING = FromPoseConfig(threshold=ThresholdConfig(kind="fixed", fixed=-1.0))


def words() -> TextTable:
    vectors = np.random.default_rng(5).normal(size=(len(NAMES), CHANNELS))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return make_text_table(NAMES, vectors.astype(np.float32), "toy")


def opaque_ball(n: int = 400) -> Gaussians:
    ball = random_gaussians(n, log_scale=-1.6)
    return replace(ball, opacities=np.sqrt(ball.opacities))


def some_features(n: int, kind: str) -> GaussianFeatures:
    """Random features with a mean, some of them never seen: as vectors, in a basis, or rows of a shared table."""
    rng = np.random.default_rng(1)
    weights = rng.uniform(0.1, 2, n).astype(np.float32)
    weights[::5] = 0
    mean = (3 * rng.normal(size=CHANNELS)).astype(np.float32)
    basis, index, rows, columns = None, None, n, CHANNELS
    if kind == "basis":
        columns = 35
        components = np.linalg.qr(rng.normal(size=(CHANNELS, columns)))[0].T.astype(np.float32)
        basis = FeatureBasis(mean=mean, components=components, energy_kept=0.9, space=SPACE)
    if kind == "table":
        rows = 7
        index = np.where(weights > 0, rng.integers(0, rows, n), -1).astype(np.int32)
    values = rng.normal(size=(rows, columns)).astype(np.float32) + (0 if basis else mean)
    if index is None:
        values[weights == 0] = 0
    return GaussianFeatures(
        features=values.astype(np.float32), weights=weights, mean=mean, space=SPACE, basis=basis, index=index
    )


def scene_of(gaussians: Gaussians, features: GaussianFeatures, origin: tuple[float, float, float] = (0, 0, 0)) -> Scene:
    return Scene(name="toy", gaussians=gaussians, features={"toy": features}, origin=np.array(origin, np.float64))


def plain_relevancy(
    scene: Scene, cameras: Cameras, text: TextTable, names: tuple[str, ...]
) -> Float64[np.ndarray, "Q P"]:
    """The definition: features of all channels are rendered, then centered cosines; −2 where alpha is below 0.5."""
    assert scene.gaussians is not None
    features = scene.features["toy"]
    b = blend(scene.gaussians, cameras)
    dense = np.zeros((b.rows, b.gaussians))
    rows = np.repeat(np.arange(b.rows), np.diff(b.crow.numpy()))
    np.add.at(dense, (rows, b.col.numpy()), b.weight.numpy().astype(np.float64))
    dense[:, ~features.seen] = 0
    alpha = dense.sum(axis=1)
    decoded = features.decode().astype(np.float64)
    local = dense @ decoded / np.maximum(alpha, 1e-300)[:, None] - features.mean
    # A feature much shorter than the mean has no direction: `relevancy` adds a thousandth of the mean's length.
    length = np.sqrt(
        (local**2).sum(axis=1, keepdims=True) + 1e-6 * float((features.mean.astype(np.float64) ** 2).sum())
    )
    local /= length
    targets = text.encode(names).astype(np.float64) - text.mean
    targets /= np.linalg.norm(targets, axis=1, keepdims=True)
    return np.where(alpha >= 0.5, targets @ local.T, -2)


@pytest.mark.parametrize("kind", ["vectors", "basis", "table"])
def test_the_pixel_is_where_an_exhaustive_search_over_the_plain_definition_finds_it(kind: str) -> None:
    gaussians, cameras, text = opaque_ball(), front_camera(), words()
    scene = scene_of(gaussians, some_features(len(gaussians), kind))
    plain = plain_relevancy(scene, cameras, text, NAMES)
    assert (plain > -2).any()
    for point, scores in zip(from_pose(scene, cameras, NAMES, text), plain, strict=True):
        column, row = (point.pixel - 0.5).astype(int)
        at = row * 61 + column
        # Of pixels that are even but for rounding either may be found.
        assert scores[at] == pytest.approx(scores.max(), abs=5e-6)
        assert point.relevancy == pytest.approx(scores[at], abs=5e-6)
        assert (point.pixel % 1 == 0.5).all()


def test_maps_of_relevancy_are_the_plain_definition_and_nan_where_there_is_no_surface() -> None:
    gaussians, cameras, text = opaque_ball(), front_camera(), words()
    scene = scene_of(gaussians, some_features(len(gaussians), "basis"))
    maps = FeatureField(scene).at(cameras).relevancy(NAMES[:3], text)
    plain = plain_relevancy(scene, cameras, text, NAMES[:3]).reshape(maps.shape)
    assert np.array_equal(np.isnan(maps), plain == -2)
    assert 0 < np.isnan(maps).sum() < maps.size
    np.testing.assert_allclose(maps[plain > -2], plain[plain > -2], atol=5e-6)


def test_depth_and_position_agree_with_the_camera_and_with_the_gaussians_of_the_pixel() -> None:
    gaussians, text = opaque_ball(), words()
    origin = (10.0, -20.0, 5.0)
    scene = scene_of(gaussians, some_features(len(gaussians), "basis"), origin)
    seen = FeatureField(scene).at(front_camera())
    own = relevancy(scene.features["toy"], text.encode(NAMES), text.mean)
    both = [0, 0]
    for point, scores in zip(seen.find(NAMES, text), own, strict=True):
        pixels, depths = seen.cameras.project(point.position[None] - origin, 0)
        np.testing.assert_allclose(pixels[0], point.pixel, atol=1e-6)
        assert depths[0] == pytest.approx(point.depth, rel=1e-9)
        column, row = (point.pixel - 0.5).astype(int)
        at = row * 61 + column
        assert point.alpha == pytest.approx(float(seen.b.alpha[at]), abs=1e-6)
        entries = slice(int(seen.b.crow[at]), int(seen.b.crow[at + 1]))
        columns, weights = seen.b.col[entries].numpy(), seen.b.weight[entries].numpy()
        relevant = scores[columns] >= point.threshold
        both[int(relevant.any())] += 1
        chosen = relevant if relevant.any() else np.isfinite(scores[columns])
        depths = seen.b.depths.numpy()[columns]
        assert point.depth in depths[chosen]
        before, until = (
            weights[chosen & mask].sum() / weights[chosen].sum()
            for mask in (depths < point.depth, depths <= point.depth)
        )
        assert before <= 0.5 + 1e-6
        assert until >= 0.5 - 1e-6
    assert both[1] > 0


def moved_world(gaussians: Gaussians, cameras: Cameras, R: np.ndarray, t: np.ndarray) -> tuple[Gaussians, Cameras]:
    """Gaussians and cameras after x ↦ R x + t."""
    turned = Rotation.from_matrix(R) * Rotation.from_quat(gaussians.quats[:, [1, 2, 3, 0]])
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = R.T, -R.T @ t
    poses = cameras.cam_from_world.astype(np.float64) @ inverse
    return (
        replace(
            gaussians,
            means=(gaussians.means @ R.T + t).astype(np.float32),
            quats=turned.as_quat()[:, [3, 0, 1, 2]].astype(np.float32),
        ),
        replace(cameras, cam_from_world=poses.astype(np.float32)),
    )


def test_a_world_that_is_rotated_and_moved_moves_the_positions(rng: np.random.Generator) -> None:
    gaussians, cameras, text = opaque_ball(), front_camera(), words()
    features = some_features(len(gaussians), "basis")
    R, t = random_rotation(rng), rng.normal(size=3)
    before = from_pose(scene_of(gaussians, features), cameras, NAMES, text)
    others, looking = moved_world(gaussians, cameras, R, t)
    after = from_pose(scene_of(others, features), looking, NAMES, text)
    same = [np.array_equal(a.pixel, b.pixel) for a, b in zip(before, after, strict=True)]
    assert np.mean(same) >= 0.9  # Rounding may prefer another of two even pixels.
    for a, b, alike in zip(before, after, same, strict=True):
        assert a.relevancy == pytest.approx(b.relevancy, abs=1e-4)
        if alike:
            np.testing.assert_allclose(b.position, R @ a.position + t, atol=1e-4)


def test_an_origin_a_thousand_kilometres_away_loses_nothing() -> None:
    gaussians, cameras, text = opaque_ball(), front_camera(), words()
    features, origin = some_features(len(gaussians), "basis"), (1e6, -2e6, 3e6)
    near = from_pose(scene_of(gaussians, features), cameras, NAMES, text)
    far = from_pose(scene_of(gaussians, features, origin), cameras, NAMES, text)
    for a, b in zip(near, far, strict=True):
        assert np.array_equal(a.pixel, b.pixel)
        np.testing.assert_allclose(b.position - origin, a.position, atol=1e-9)


def two_kinds(first: Gaussians, second: Gaussians) -> tuple[Gaussians, GaussianFeatures]:
    """Gaussians of two kinds whose features are the words a and b themselves."""
    joined = Gaussians(
        **{
            name: np.concatenate([getattr(first, name), getattr(second, name)])
            for name in ("means", "quats", "scales", "opacities", "sh")
        }
    )
    kinds = np.repeat([0, 1], [len(first), len(second)])
    # The means of features and words are far from both, so that neither is the mean's opposite of the other.
    features = GaussianFeatures(
        features=words().encode(NAMES[:2])[kinds],
        weights=np.ones(len(joined), np.float32),
        mean=words().mean,
        space=SPACE,
    )
    return joined, features


def test_one_gaussian_is_found_at_its_depth() -> None:
    gaussians = one_gaussian((0.3, -0.2, 2.0), scale=0.1, opacity=0.8)
    features = some_features(2, "vectors")
    features = replace(features, features=features.features[1:], weights=features.weights[1:])
    (point,) = from_pose(scene_of(gaussians, features), front_camera(), NAMES[:1], words(), EVERYTHING)
    assert point.visible
    assert point.depth == 2.0
    assert np.linalg.norm(point.position - (0.3, -0.2, 2.0)) < 0.15
    expected = relevancy(features, words().encode(NAMES[:1]), words().mean)[0, 0]
    assert point.relevancy == pytest.approx(expected, abs=1e-5)


def assert_nothing(point: PosePoint) -> None:
    assert not point.visible
    values = [point.relevancy, point.alpha, point.depth, *point.pixel, *point.position]
    assert np.isnan(values).all()


@pytest.mark.parametrize("case", ["behind", "faint", "never seen", "no Gaussians"])
def test_where_no_surface_with_features_is_in_view_nothing_is_visible(case: str) -> None:
    gaussians = one_gaussian((0, 0, -2 if case == "behind" else 2), opacity=0.4 if case == "faint" else 0.9)
    features = GaussianFeatures(
        features=np.zeros((1, CHANNELS), np.float32),
        weights=np.full(1, case != "never seen", np.float32),
        mean=np.ones(CHANNELS, np.float32),
        space=SPACE,
    )
    if case == "no Gaussians":
        gaussians = gaussians.select(np.zeros(0, int))
        features = replace(features, features=features.features[:0], weights=features.weights[:0])
    scene = scene_of(gaussians, features)
    (point,) = from_pose(scene, front_camera(), NAMES[:1], words(), EVERYTHING)
    assert_nothing(point)
    assert np.isnan(FeatureField(scene).at(front_camera()).relevancy(NAMES[:1], words())).all()


def test_features_of_an_empty_table_are_nowhere() -> None:
    features = GaussianFeatures(
        features=np.zeros((0, CHANNELS), np.float32),
        weights=np.zeros(1, np.float32),
        mean=np.ones(CHANNELS, np.float32),
        space=SPACE,
        index=np.full(1, -1, np.int32),
    )
    (point,) = from_pose(scene_of(one_gaussian(), features), front_camera(), NAMES[:1], words())
    assert_nothing(point)
    assert np.isnan(point.threshold)


def test_a_word_whose_object_is_behind_the_camera_is_not_visible_until_the_camera_turns() -> None:
    gaussians, features = two_kinds(one_gaussian((0, 0, 2)), one_gaussian((0, 0, -2)))
    scene, camera = scene_of(gaussians, features), front_camera()
    ahead, behind = from_pose(scene, camera, NAMES[:2], words())
    assert ahead.visible
    assert ahead.relevancy == pytest.approx(1, abs=1e-5)
    assert not behind.visible
    assert behind.relevancy < behind.threshold
    turned = replace(camera, cam_from_world=np.diag([-1, 1, -1, 1]).astype(np.float32)[None])
    a, b = from_pose(scene, turned, NAMES[:2], words())
    assert (a.visible, b.visible) == (False, True)
    assert b.position[2] == pytest.approx(-2)


def test_a_word_behind_something_opaque_is_not_visible() -> None:
    gaussians, features = two_kinds(one_gaussian((0, 0, 2), 0.5, 0.999), one_gaussian((0, 0, 4), 0.05, 0.999))
    front, hidden = from_pose(scene_of(gaussians, features), front_camera(), NAMES[:2], words())
    assert front.visible
    assert not hidden.visible


def test_the_depth_is_that_of_what_is_relevant_and_not_between_it_and_the_background() -> None:
    """Each ray ends partly at the near Gaussian: the mean of both depths is in empty space."""
    for opacity in (0.7, 0.3):
        near, far = one_gaussian((0, 0, 2), 3.0, opacity), one_gaussian((0, 0, 8), 9.0, 0.999)
        gaussians, features = two_kinds(near, far)
        point, _ = from_pose(scene_of(gaussians, features), front_camera(), NAMES[:2], words(), EVERYTHING)
        assert point.depth == (2.0 if opacity == 0.7 else 8.0)  # All reach this threshold.
        least = FromPoseConfig(threshold=ThresholdConfig(kind="fixed", fixed=0.5))
        a, b = from_pose(scene_of(gaussians, features), front_camera(), NAMES[:2], words(), least)
        assert (a.depth, b.depth) == (2.0, 8.0)


def test_a_small_share_before_a_background_of_the_mean_feature_has_its_own_depth() -> None:
    gaussians, features = two_kinds(one_gaussian((0, 0, 2), 3.0, 0.2), one_gaussian((0, 0, 8), 9.0, 0.999))
    features = replace(features, features=np.stack([features.features[0], features.mean]))
    (point,) = from_pose(scene_of(gaussians, features), front_camera(), NAMES[:1], words())
    assert point.relevancy == pytest.approx(1, abs=1e-4)
    assert point.depth == 2.0


def test_words_together_are_as_one_by_one_and_a_kept_blend_answers_as_a_new_one() -> None:
    gaussians, cameras, text = opaque_ball(), front_camera(), words()
    field = FeatureField(scene_of(gaussians, some_features(len(gaussians), "basis")))
    kept = field.at(cameras, b=blend(gaussians, cameras))
    assert len(NAMES) > 16
    for together, name in zip(kept.find(NAMES, text), NAMES, strict=True):
        (alone,) = field.at(cameras).find([name], text)
        assert np.array_equal(together.pixel, alone.pixel)
        assert together.relevancy == pytest.approx(alone.relevancy, abs=1e-6)
        assert together.threshold == pytest.approx(alone.threshold, abs=1e-6)


def test_cameras_are_answered_in_order_each_with_all_words() -> None:
    gaussians, features = two_kinds(one_gaussian((0, 0, 2)), one_gaussian((0, 0, -2)))
    poses = np.stack([np.eye(4), np.diag([-1.0, 1, -1, 1])]).astype(np.float32)
    one = front_camera()
    cameras = Cameras(
        cam_from_world=poses, Ks=one.Ks.repeat(2, 0), widths=one.widths.repeat(2), heights=one.heights.repeat(2)
    )
    points = from_pose(scene_of(gaussians, features), cameras, NAMES[:2], words())
    assert [(point.camera, point.query, point.visible) for point in points] == [
        (0, NAMES[0], True),
        (0, NAMES[1], False),
        (1, NAMES[0], False),
        (1, NAMES[1], True),
    ]


@pytest.mark.parametrize(("width", "height"), [(61, 43), (2, 1), (8, 5), (1, 9)])
@pytest.mark.parametrize("stride", [1, 3, 4])
def test_rays_at_a_stride_are_those_of_their_pixels(width: int, height: int, stride: int) -> None:
    gaussians, cameras = opaque_ball(), front_camera(width, height)
    full, strided = blend(gaussians, cameras), blend(gaussians, cameras, stride=stride)
    lattice = strided.lattice
    x = lattice.x0 + lattice.dx * np.arange(lattice.width)
    y = lattice.y0 + lattice.dy * np.arange(lattice.height)
    assert (x < width).all()
    assert (y < height).all()
    assert x[-1] + stride > width - stride
    of_pixels = full.alpha.reshape(full.shape)[np.ix_((y - 0.5).astype(int), (x - 0.5).astype(int))]
    torch.testing.assert_close(strided.alpha.reshape(strided.shape), of_pixels, rtol=0, atol=1e-6)


def test_at_a_stride_the_best_of_these_pixels_is_found() -> None:
    gaussians, cameras, text = opaque_ball(), front_camera(), words()
    scene = scene_of(gaussians, some_features(len(gaussians), "basis"))
    plain = plain_relevancy(scene, cameras, text, NAMES).reshape(len(NAMES), 43, 61)[:, 2::4, 2::4]
    for point, scores in zip(from_pose(scene, cameras, NAMES, text, FromPoseConfig(stride=4)), plain, strict=True):
        column, row = (point.pixel - 2.5).astype(int) // 4
        assert scores[row, column] == pytest.approx(scores.max(), abs=5e-6)


def memory_of(n: int, *, components: int, temperature: float = 0.05) -> QueryMemory:
    rng = np.random.default_rng(2)
    weights = rng.uniform(0.5, 2, n).astype(np.float32)
    weights[::7] = 0
    mean = rng.normal(size=CHANNELS).astype(np.float32)
    queries = rng.normal(size=(n, 6)).astype(np.float32)
    queries[weights == 0] = 0
    bank = MemoryBank(
        components=(rng.normal(size=(components, CHANNELS)) + mean).astype(np.float32),
        sources=np.zeros((components, 3), np.int32),
        grid_from_image=np.tile(np.eye(2, 3), (components, 1, 1)),
        mean=mean,
        threshold=0.9,
        coverage=1.0,
        cosine=0.95,
        space=SPACE,
    )
    projection = rng.normal(size=(6, CHANNELS)).astype(np.float32)
    return QueryMemory(
        queries=queries,
        weights=weights,
        projection=projection,
        bank=bank,
        scoring="centered",
        temperature=temperature,
        mean=mean,
    )


@pytest.mark.parametrize("components", [9, 90])
def test_the_features_of_a_memory_are_those_that_blended_queries_attend_to(components: int) -> None:
    gaussians, cameras, text = opaque_ball(), front_camera(), words()
    memory = memory_of(len(gaussians), components=components)
    scene = Scene(name="toy", gaussians=gaussians)
    field = FeatureField(scene, memory=memory, config=FromPoseConfig(stride=1))
    maps = field.at(cameras).relevancy(NAMES, text)
    plain, _ = render_features(memory, blend(gaussians, cameras))
    local = plain.astype(np.float64) - memory.mean
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    expected = (word_directions(text.encode(NAMES), text.mean) @ local.T).reshape(maps.shape)
    opaque = np.isfinite(maps)
    assert opaque.any()
    np.testing.assert_allclose(maps[opaque], expected[opaque], atol=1e-4)
    for point in field.at(cameras).find(NAMES, text):
        column, row = (point.pixel - 0.5).astype(int)
        scores = np.where(opaque, expected, -2)[NAMES.index(point.query)]
        assert scores[row, column] == pytest.approx(scores.max(), abs=1e-4)


def test_a_memory_answers_as_features_where_its_attention_is_exact() -> None:
    """Queries that fit one component each, and no pixel that blends two kinds."""
    gaussians, features = two_kinds(one_gaussian((-0.7, 0, 2)), one_gaussian((0.7, 0, 2)))
    local = features.features - features.mean
    bank = MemoryBank(
        components=features.features,
        sources=np.zeros((2, 3), np.int32),
        grid_from_image=np.tile(np.eye(2, 3), (2, 1, 1)),
        mean=features.mean,
        threshold=0.9,
        coverage=1.0,
        cosine=1.0,
        space=SPACE,
    )
    memory = QueryMemory(
        queries=local, weights=features.weights, projection=np.eye(CHANNELS, dtype=np.float32), bank=bank,
        scoring="centered", temperature=0.01, mean=features.mean,
    )  # fmt: skip
    scene, config = scene_of(gaussians, features), FromPoseConfig(stride=1)
    plain, remembered = (
        FeatureField(scene, memory=each, config=config).at(front_camera()).relevancy(NAMES[:2], words())
        for each in (None, memory)
    )
    assert np.isfinite(plain).any()
    np.testing.assert_allclose(remembered, plain, atol=1e-5)
    for a, b in zip(
        from_pose(scene, front_camera(), NAMES[:2], words(), config),
        from_pose(scene, front_camera(), NAMES[:2], words(), config, memory=memory),
        strict=True,
    ):
        assert a.visible
        assert b.visible
        assert a.threshold == pytest.approx(b.threshold, abs=1e-5)
        np.testing.assert_allclose(b.position, a.position, atol=0.3)
    assert FeatureField(scene, memory=memory).stride_in(front_camera(), 0) == 4


def test_wrong_input_is_refused() -> None:
    gaussians, cameras, text = opaque_ball(), front_camera(), words()
    scene = scene_of(gaussians, some_features(len(gaussians), "basis"))
    field = FeatureField(scene)
    with pytest.raises(InputError, match="one or more words"):
        field.at(cameras).find([], text)
    with pytest.raises(InputError, match="one or more words"):
        field.at(cameras).find("word a", text)
    with pytest.raises(InputError):
        field.at(cameras).find(["unheard of"], text)
    with pytest.raises(InputError):
        field.at(cameras).find(["a"], make_text_table(("a",), np.eye(1, CHANNELS, dtype=np.float32), "other"))
    with pytest.raises(InputError, match="expected a blend of 61×43 rays"):
        field.at(cameras, b=blend(gaussians, cameras, stride=2))
    with pytest.raises(InputError, match="400 Gaussians, and a view of 1"):
        field.at(cameras, b=blend(one_gaussian(), cameras))
    with pytest.raises(InputError, match="queries of 3 Gaussians"):
        FeatureField(scene, memory=memory_of(3, components=4))
    with pytest.raises(InputError, match="view: expected 0 to 0"):
        field.at(cameras, 1)
    with pytest.raises(InputError, match="no features"):
        FeatureField(replace(scene, features={}))
    for options in ({"stride": 0}, {"min_alpha": 0.0}, {"min_alpha": float("nan")}):
        with pytest.raises(InputError, match=next(iter(options))):
            FromPoseConfig(**options)  # type: ignore[arg-type]


def test_large_views_are_looked_at_in_fewer_pixels_and_drawn_small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsencoder.infer.localize.from_pose.MAX_RAYS", 500)
    monkeypatch.setattr("gsencoder.infer.draw.pose_pictures.MAX_SIDE", 40)
    gaussians, features = two_kinds(one_gaussian((-0.7, 0, 2)), one_gaussian((0.7, 0, 2)))
    camera = front_camera()
    width, height = int(camera.widths[0]), int(camera.heights[0])
    field = FeatureField(scene_of(gaussians, features))
    stride = field.stride_in(camera, 0)
    assert stride > 1
    assert -(-width // stride) * -(-height // stride) <= 500 < -(-width // (stride - 1)) * -(-height // (stride - 1))
    seen = field.at(camera)
    (point,) = seen.find(NAMES[:1], words())
    whole = FeatureField(scene_of(gaussians, features), config=FromPoseConfig(stride=1)).at(camera)
    (exact,) = whole.find(NAMES[:1], words())
    np.testing.assert_allclose(point.position, exact.position, atol=0.1)
    rgb = view_picture(seen)
    assert max(rgb.shape[:2]) == 40
    (relevancy,) = seen.relevancy(NAMES[:1], words())
    small = pose_picture(rgb, seen, point, relevancy)
    monkeypatch.setattr("gsencoder.infer.draw.pose_pictures.MAX_SIDE", 2000)
    large = pose_picture(view_picture(seen), seen, point, relevancy)
    # Both are enlarged to be legible; the ring is in one place.
    assert abs(small.shape[0] / small.shape[1] - large.shape[0] / large.shape[1]) < 0.1


def test_a_stride_that_is_asked_for_holds_in_views_of_any_size() -> None:
    gaussians, features = two_kinds(one_gaussian((-0.7, 0, 2)), one_gaussian((0.7, 0, 2)))
    field = FeatureField(scene_of(gaussians, features), config=FromPoseConfig(stride=3))
    huge = replace(front_camera(), widths=np.array([1 << 24], np.int32), heights=np.array([1], np.int32))
    assert field.stride_in(huge, 0) == 3
    free = FeatureField(scene_of(gaussians, features)).stride_in(huge, 0)
    assert -(-(1 << 24) // free) <= MAX_RAYS
