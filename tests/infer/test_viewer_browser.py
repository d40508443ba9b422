"""The page in a real Chromium, drawn by software: words paint, boxes appear, clicks name, and nothing escapes."""

import io
import re
import shutil
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from viewed_rooms import HOSTILE, room_scene, save_viewed_room, search_of

from gsencoder.core.errors import InputError
from gsencoder.infer.localize import localize
from gsencoder.infer.page.page import (
    Bundle,
    FileOptions,
    file_container,
    file_page,
    load_bundle,
    scene_container,
    served_page,
)
from gsencoder.infer.page.search import SceneSearch
from gsencoder.infer.page.server import ViewServer
from gsencoder.infer.relevancy import relevancy
from gsencoder.types import Scene

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 740, 360
OPTIONS = FileOptions(error=0.01, sh_degree=3, photographs=6, photograph_side=96)
WAIT = 60_000


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    try:
        return load_bundle()
    except InputError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        pytest.skip("there is no chromium on the path (Debian: apt-get install chromium)")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")
    with playwright.sync_playwright() as driver:
        # WebGL is drawn by SwiftShader where there is no graphics card.
        opened = driver.chromium.launch(
            executable_path=program, args=["--no-sandbox", "--enable-unsafe-swiftshader"], chromium_sandbox=False
        )
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return room_scene()


@pytest.fixture(scope="module")
def search(tmp_path_factory: pytest.TempPathFactory, scene: Scene) -> SceneSearch:
    folder = tmp_path_factory.mktemp("seen")
    save_viewed_room(folder)
    search = search_of(folder / "features")
    search.display = replace(search.display, scene=replace(search.display.scene, views=scene.views))
    return search


def opened_page(browser: Any, address: str, *, offline: bool = False) -> Any:
    """A page that is ready; errors of its script fail the test."""
    context = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}, offline=offline)
    page = context.new_page()
    page.set_default_timeout(WAIT)
    page.problems = []
    page.on("pageerror", lambda error: page.problems.append(str(error)))
    page.on("console", lambda message: page.problems.append(message.text) if message.type == "error" else None)
    page.goto(address)
    page.wait_for_selector("body[data-state=ready]")
    return page


def picture_of(page: Any) -> np.ndarray:
    """What the page looks like when it rests."""
    page.evaluate("gsencoderViewer.frame()")
    with Image.open(io.BytesIO(page.screenshot(timeout=WAIT))) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def numbers_of(text: str) -> list[int]:
    """The whole numbers of a sentence: of boxes, and of Gaussians."""
    return [int(number.replace(",", "")) for number in re.findall(r"[\d,]*\d", text)]


def seen_mug(scene: Scene) -> tuple[int, list[float]]:
    """The view that shows most of the mug, and a point of the mug in it."""
    views = scene.views
    number = next(each.id for each in scene.objects if each.name == "mug")
    view = int(np.argmax([(views.instances[view] == number).sum() for view in range(len(views))]))
    rows, columns = np.nonzero(views.instances[view] == number)
    middle = np.argmin((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2)
    depth = np.array([views.depths[view][rows[middle], columns[middle]]], np.float64)
    pixel = np.array([[columns[middle] + 0.5, rows[middle] + 0.5]], np.float64)
    return view, views.cameras.unproject(pixel, depth, view)[0].tolist()


def find_and_click_the_mug(page: Any, scene: Scene, search: SceneSearch) -> None:
    """Types the word, reads the pixels, clicks, and moves the slider, as a person does."""
    view, point = seen_mug(scene)
    page.evaluate("view => gsencoderViewer.stand(view)", view)
    before = picture_of(page)
    position = page.evaluate("point => gsencoderViewer.placeOf(0, point)", point)
    x, y = round(position["x"]), round(position["y"])
    assert np.ptp(before[:, : WIDTH - 300].reshape(-1, 3), axis=0).min() > 60  # a scene, and no flat color
    page.fill("input[type=search]", "the Mug")
    page.press("input[type=search]", "Enter")
    page.wait_for_selector("body[data-judged]")
    after = picture_of(page)
    red, green, blue = after[y, x]
    assert red > 60
    assert max(green, blue) < 0.55 * red
    assert np.abs(after[y, x] - before[y, x]).max() > 40
    # All but the mug is nearly grey, and darker.
    room = after[:, : WIDTH - 300]
    assert np.quantile(np.ptp(room, axis=2), 0.9) < 30
    assert np.median(room) < 0.8 * np.median(before[:, : WIDTH - 300])
    found = localize(search.display.scene, ["mug"], search.words, search.config).boxes
    boxes = page.evaluate(
        "gsencoderViewer.shown[0].boxes.map(b => [b.center, b.size, b.probability, b.score, b.count])"
    )
    assert len(boxes) == len(found)
    center, size, probability, score, count = boxes[0]
    np.testing.assert_allclose(center, found[0].obb_center - search.display.scene.origin, atol=1e-6)
    np.testing.assert_allclose(size, found[0].obb_size)
    assert (count, probability, score) == (len(found[0].rows), found[0].probability, found[0].score)
    assert "mug" in page.inner_text(".label").lower()
    page.mouse.click(x, y)
    page.wait_for_selector(".selected h2")
    assert page.inner_text(".selected .word bdi") == "mug"
    assert page.locator(".selected .view img").count() >= 1
    selected = numbers_of(page.inner_text(".status"))
    page.evaluate(
        "const slider = document.querySelector('input[type=range]');"
        "slider.value = '0.9'; slider.dispatchEvent(new Event('input'));"
    )
    fewer = numbers_of(page.inner_text(".status"))
    assert 0 < fewer[-1] < selected[-1]
    assert page.inner_text("output") == "0.90"
    page.click(".threshold .link")
    page.wait_for_function(f"gsencoderViewer.shown[0].boxes.length == {len(found)}")
    assert page.problems == []
    assert page.title().startswith("room")


def test_a_served_page_finds_what_is_typed(browser: Any, bundle: Bundle, search: SceneSearch, scene: Scene) -> None:
    page = served_page(bundle, "room", {"kind": "server", "scenes": 1, "notes": []})
    with ViewServer(page, [search], [scene_container(search, scene.objects)]) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        shown = opened_page(browser, server.address)
        find_and_click_the_mug(shown, scene, search)
        # A server finds the boxes of every threshold.
        shown.evaluate("gsencoderViewer.setThreshold(0.3)")
        expected = len(search.boxes("mug", 0.3)["boxes"])
        shown.wait_for_function(f"gsencoderViewer.shown[0].boxes.length == {expected}")
        told = shown.evaluate("async () => Array.from((await gsencoderViewer.shown[0].answers.ask('lamp')).relevancy)")
        exact = relevancy(search.display.features, search.words.encode(["lamp"]), search.words.mean)[0]
        np.testing.assert_allclose(np.array(told, float), exact, atol=2e-5)
        assert np.isnan(exact).any()
        shown.fill("input[type=search]", "banjo")
        shown.press("input[type=search]", "Enter")
        shown.wait_for_selector(".status .bad")
        assert "not among" in shown.inner_text(".status")
        shown.evaluate("Promise.all(['pca', 'weight', 'label', 'object'].map(m => gsencoderViewer.color(m)))")
        shown.context.close()
        server.shutdown()
        thread.join()


def test_a_page_of_one_file_does_the_same_without_a_network(browser, bundle, search, scene, tmp_path):
    container = file_container(search, scene.objects, OPTIONS)
    settings = {"kind": "file", "scenes": 1, "notes": []}
    (tmp_path / "page.html").write_bytes(file_page(bundle, "room", settings, [container]))
    page = opened_page(browser, (tmp_path / "page.html").as_uri(), offline=True)
    find_and_click_the_mug(page, scene, search)
    for name in ("mug", "lamp"):
        exact = relevancy(search.display.features, search.words.encode([name]), search.words.mean)[0]
        told = page.evaluate(
            "async word => Array.from((await gsencoderViewer.shown[0].answers.ask(word)).relevancy, "
            "value => Number.isNaN(value) ? null : value)",
            name,
        )
        shown = np.array([np.nan if value is None else value for value in told])
        np.testing.assert_array_equal(np.isnan(shown), np.isnan(exact))
        budget = container.meta["featureError"]
        assert np.sqrt(np.nanmean((shown - exact) ** 2)) <= np.sqrt(2 * budget) + 1e-4
    page.evaluate("gsencoderViewer.ask('piano')")
    page.wait_for_selector("body[data-judged=piano]")
    assert "absent" in page.inner_text(".status")
    page.context.close()


def test_two_folders_of_a_scene_stand_side_by_side_and_names_are_text(browser, bundle, tmp_path):
    save_viewed_room(tmp_path, rename={"mug": HOSTILE}, name="harm <script> 'x'")
    search = search_of(tmp_path / "features")
    search.display = replace(search.display, title=HOSTILE)
    containers = [file_container(search, search.display.scene.objects, replace(OPTIONS, photographs=0))] * 2
    settings = {"kind": "file", "scenes": 2, "notes": [HOSTILE]}
    (tmp_path / "page.html").write_bytes(file_page(bundle, HOSTILE, settings, containers))
    page = opened_page(browser, (tmp_path / "page.html").as_uri(), offline=True)
    assert page.locator(".pane").count() == 2
    page.evaluate("word => gsencoderViewer.ask(word)", HOSTILE)
    page.wait_for_selector("body[data-judged]")
    assert HOSTILE in str(page.locator(".label").first.text_content())
    page.click(".box")
    page.wait_for_selector(".selected h2")
    assert page.locator(".selected .words").count() == 2
    assert page.text_content(".selected .word bdi") == HOSTILE
    assert page.locator("img[src=x]").count() == 0
    assert page.locator("script").count() == 2  # the settings and the bundle; the scenes were read and removed
    assert "harmed" not in page.title().replace(HOSTILE, "")
    assert page.problems == []
    page.context.close()


def test_a_browser_without_webgl_shows_a_sentence(browser: Any, bundle: Bundle, tmp_path: Path) -> None:
    (tmp_path / "page.html").write_bytes(file_page(bundle, "room", {"kind": "file", "scenes": 0, "notes": []}, []))
    page = browser.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto((tmp_path / "page.html").as_uri())
    page.wait_for_selector("body[data-state=failed]")
    assert "WebGL" in page.inner_text(".message")
    page.close()
