"""What a pixel attends to, and pictures of it: the components are the strongest, and their cells are outlined."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from memory_samples import make_memory
from memory_scenes import prepared_wall
from training_scenes import scene as wall

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.infer import memory_pictures as module
from gsencoder.infer.memory_pictures import (
    HALO,
    MARK,
    SIDE,
    attention_entropy,
    attention_picture,
    attention_pictures,
    cell_tile,
    mark_pixel,
    salient_pixel,
    strongest_components,
)
from gsencoder.memory.attention import render_queries
from gsencoder.memory.bank import BankConfig
from gsencoder.render import blend
from gsencoder.render.images import render_image
from gsencoder.train.memory import MemoryConfig, untrained_memory
from gsencoder.types import QueryMemory, Scene

GREY = np.full((60, 80, 3), 90, np.uint8)


@pytest.fixture(scope="module")
def memory(tmp_path_factory: pytest.TempPathFactory) -> QueryMemory:
    """Of the wall, without training."""
    made = prepared_wall(tmp_path_factory.mktemp("memory"), bank=BankConfig(threshold=0.9))
    return untrained_memory(made, MemoryConfig(channels=5))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return wall(0)


def with_photographs(scene: Scene) -> Scene:
    rng = np.random.default_rng(0)
    photographs = [rng.integers(0, 256, (40, 48, 3), dtype=np.uint8) for _ in range(len(scene.views))]
    return replace(scene, views=replace(scene.views, images=photographs))


def first_components(memory: QueryMemory, count: int) -> QueryMemory:
    parts = {name: getattr(memory.bank, name)[:count] for name in ("components", "sources", "grid_from_image")}
    return replace(memory, bank=replace(memory.bank, **parts))


def in_color(picture: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    return np.asarray((picture == np.array(color)).all(axis=2))


def strongest(
    memory: QueryMemory, scene: Scene, view: int = 0, pixel: tuple[int, int] = (24, 20), count: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    return strongest_components(memory, blend(scene.gaussians, scene.views.cameras, view), pixel, count)


@pytest.mark.parametrize(("view", "pixel"), [(0, (24, 20)), (1, (18, 11))])
def test_the_components_are_the_first_of_the_attention_of_the_pixels_query(memory, scene, view, pixel):
    b = blend(scene.gaussians, scene.views.cameras, view)
    seen = torch.from_numpy((memory.weights > 0).astype(np.float32))
    row = pixel[1] * b.shape[1] + pixel[0]
    query = (b.render(torch.from_numpy(memory.queries)) / b.render(seen)[:, None])[row].numpy()
    attention = memory.attention(query[None])[0]
    components, weights = strongest_components(memory, b, pixel, 4)
    np.testing.assert_allclose(weights, np.sort(attention)[::-1][:4], rtol=1e-5)
    np.testing.assert_allclose(attention[components], weights, rtol=1e-5)


def test_weights_of_all_components_sum_to_one_and_a_bank_may_have_fewer(memory: QueryMemory, scene: Scene) -> None:
    components, weights = strongest(memory, scene, count=10_000)
    assert sorted(components.tolist()) == list(range(len(memory.bank)))
    assert weights.sum() == pytest.approx(1, abs=1e-5)
    assert (np.diff(weights) <= 0).all()
    single, whole = strongest(first_components(memory, 1), scene)
    assert (single.tolist(), whole.tolist()) == ([0], [1.0])
    # Of equal components the first come first: of eight, which a matrix product computes alike.
    eight = first_components(memory, 8)
    tied = replace(eight, bank=replace(eight.bank, components=np.repeat(eight.bank.components[:1], 8, axis=0)))
    assert strongest(tied, scene)[0].tolist() == [0, 1, 2]


def test_a_pixel_outside_of_the_view_or_that_hits_nothing_is_refused(memory: QueryMemory, scene: Scene) -> None:
    for pixel in ((-1, 5), (48, 5), (5, 40)):
        with pytest.raises(InputError, match="expected a column from 0 to 47 and a row from 0 to 39"):
            attention_picture(memory, scene, 0, pixel)
    with pytest.raises(InputError, match=r"pixel \(0, 0\): no Gaussian with a query is seen in this pixel"):
        attention_picture(memory, scene, 1, (0, 0))


def test_memories_views_and_counts_that_do_not_fit_are_refused(memory: QueryMemory, scene: Scene) -> None:
    for view in (-1, 2):
        with pytest.raises(InputError, match=f"has 2 views, and view {view} is asked for"):
            attention_picture(memory, scene, view, (24, 20))
    third = replace(memory.bank, sources=memory.bank.sources + np.array([2, 0, 0], np.int32))
    with pytest.raises(InputError, match=r"components come from view [23]; expected the views that the memory was"):
        attention_picture(replace(memory, bank=third), scene, 0, (24, 20))
    with pytest.raises(InputError, match="queries of 200 Gaussians, and a view of 400"):
        attention_picture(make_memory(), scene, 0, (24, 20))
    for lacking in (replace(scene, views=None), Scene(name="empty", views=scene.views)):
        with pytest.raises(InputError, match="needs Gaussians and cameras"):
            attention_picture(memory, lacking, 0, (24, 20))


@pytest.mark.parametrize("cell", [(0, 0, 10, 10), (70, 50, 80, 60), (12.5, 41.25, 17.5, 46.25)])
def test_the_outline_lies_around_the_cell_and_the_cell_stays_as_it_is(cell: tuple[float, ...]) -> None:
    rng = np.random.default_rng(0)
    photograph = rng.integers(0, 200, (60, 80, 3), dtype=np.uint8)
    factor = SIDE / 80
    tile = cell_tile(photograph, np.array(cell, np.float64))
    assert tile.shape == (360, 480, 3)
    left, top, right, bottom = (edge * factor for edge in cell)
    rows, columns = np.nonzero(in_color(tile, MARK))
    near = (columns > left - 4) & (columns < right + 4) & (rows > top - 4) & (rows < bottom + 4)
    rows, columns = rows[near], columns[near]
    assert abs(columns.min() - max(left - 2, 1)) <= 1.5
    assert abs(columns.max() - min(right + 2, 478)) <= 1.5
    assert abs(rows.min() - max(top - 2, 1)) <= 1.5
    assert abs(rows.max() - min(bottom + 2, 358)) <= 1.5
    inside = np.s_[int(top) + 5 : int(bottom) - 4, int(left) + 5 : int(right) - 4]
    plain = cell_tile(photograph, np.array([0.0, 0, 80, 60]))
    np.testing.assert_array_equal(tile[inside], plain[inside])


def test_a_small_cell_is_enlarged_in_the_corner_that_is_farthest_from_it() -> None:
    """A white pixel on grey: in its place, and as a bright square in the middle of the close-up."""
    for row, column, corner in ((5, 74, (-152, 2)), (54, 5, (2, -152))):
        photograph = GREY.copy()
        photograph[row, column] = 255
        cell = np.array([column, row, column + 1, row + 1], np.float64)
        tile = cell_tile(photograph, cell)
        top, left = (start if start >= 0 else side + start for start, side in zip(corner, tile.shape, strict=False))
        close = tile[top : top + 150, left : left + 150]
        assert in_color(close, MARK).any()
        assert (close[73:77, 73:77] > 220).all()
        assert (close[73:77, 25:40] == 90).all()
    large = cell_tile(GREY, np.array([10.0, 10, 60, 50]))
    assert (in_color(large, (90, 90, 90)) | in_color(large, MARK) | in_color(large, HALO)).all()


@pytest.mark.parametrize("pixel", [(0, 0), (40, 30)])
def test_the_mark_surrounds_the_pixel_and_does_not_hide_it(pixel: tuple[int, int]) -> None:
    picture = mark_pixel(GREY, pixel)
    assert picture.shape == (360, SIDE, 3)
    x, y = ((each + 0.5) * SIDE / 80 for each in pixel)
    rows, columns = np.nonzero(in_color(picture, MARK))
    distance = np.hypot(rows - y, columns - x)
    assert 8 <= distance.min() <= 12
    assert distance.max() <= 26
    np.testing.assert_array_equal(picture[int(y), int(x)], 90)


@pytest.mark.parametrize("photographs", [True, False])
def test_a_picture_holds_the_view_and_the_photographs_of_the_components_with_their_titles(
    memory: QueryMemory, scene: Scene, photographs: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = with_photographs(scene) if photographs else scene
    # Components of both views are among those that are found.
    components, weights = strongest(memory, scene, 1)
    sources = memory.bank.sources.copy()
    sources[components, 0] = [0, 1, 0]
    memory = replace(memory, bank=replace(memory.bank, sources=sources))
    titles: list[str] = []
    sheet = module.contact_sheet
    monkeypatch.setattr(
        module, "contact_sheet", lambda shown, named, **rest: titles.extend(named) or sheet(shown, named, **rest)
    )
    picture = attention_picture(memory, scene, 1, (24, 20), count=3)
    cameras = scene.views.cameras
    shown = [mark_pixel(render_image(scene.gaussians, cameras, 1), (24, 20))]
    for component in components.tolist():
        source = int(sources[component, 0])
        image = scene.views.images[source] if photographs else render_image(scene.gaussians, cameras, source)
        shown.append(cell_tile(image, memory.bank.cells[component]))
    for number, each in enumerate(shown):
        left = 12 + 492 * number
        np.testing.assert_array_equal(picture[40 : 40 + each.shape[0], left : left + SIDE], each)
    names, ending = scene.views.names, "" if photographs else ", rendered"
    assert titles[0] == f"{names[1]}, column 24, row 20, attends to …"
    for number, (title, weight, source) in enumerate(zip(titles[1:], weights, (0, 1, 0), strict=True), start=1):
        assert title.startswith(f"{number}.  {100 * weight:.1f} %  row ")
        assert title.endswith(f" of {names[source]}{ending}")


def test_entropy_is_none_for_one_component_and_largest_for_equal_ones() -> None:
    weights = np.array([[1, 0, 0, 0], [0.25] * 4, [0.5, 0.5, 0, 0]], np.float32)
    np.testing.assert_allclose(attention_entropy(weights), [0, np.log(4), np.log(2)], atol=1e-6)


def test_the_salient_pixel_is_opaque_and_has_the_lowest_entropy_of_the_middle(memory, scene):
    b = blend(scene.gaussians, scene.views.cameras, 0)
    pixel = salient_pixel(memory, b)
    x, y = pixel
    assert 12 <= x < 36
    assert 10 <= y < 30
    queries, alpha = render_queries(memory, b)
    entropy = attention_entropy(memory.attention(queries)).reshape(40, 48)
    middle = np.where(alpha.reshape(40, 48) >= 0.5, entropy, np.inf)[10:30, 12:36]
    assert alpha.reshape(40, 48)[y, x] >= 0.5
    assert entropy[y, x] == middle.min()
    unseen = replace(memory, queries=np.zeros_like(memory.queries), weights=np.zeros_like(memory.weights))
    assert salient_pixel(unseen, b) is None


def test_where_only_the_rim_of_a_view_shows_something_the_salient_pixel_is_there(memory, scene):
    corner = (scene.gaussians.means[:, 0] < -0.75) & (memory.weights > 0)
    weights = np.where(corner, memory.weights, 0).astype(np.float32)
    rim = replace(memory, weights=weights, queries=np.where(corner[:, None], memory.queries, 0).astype(np.float32))
    b = blend(scene.gaussians, scene.views.cameras, 0)
    pixel = salient_pixel(rim, b)
    assert pixel[0] < 24


def test_evenly_spaced_views_are_drawn_and_those_that_show_nothing_are_named(memory: QueryMemory, scene: Scene) -> None:
    drawn = dict(attention_pictures(memory, scene, views=5))
    assert sorted(drawn) == [0, 1]
    assert [view for view, _ in attention_pictures(memory, scene, views=1)] == [0]
    assert [view for view, _ in attention_pictures(memory, scene, views=0)] == []
    away = scene.views.cameras.cam_from_world.copy()
    away[1] = np.diag(np.array([-1, 1, -1, 1], np.float32))
    turned = replace(scene, views=replace(scene.views, cameras=replace(scene.views.cameras, cam_from_world=away)))
    with pytest.warns(SceneWarning, match="view far shows no Gaussian with a query and is not drawn"):
        assert [view for view, _ in attention_pictures(memory, turned, views=2)] == [0]
