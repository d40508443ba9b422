"""How long a word takes on the page of `view`: on the server, in the script, and until software GL has drawn it.

    python bench/viewer.py FEATURES [--gaussians 500000] [--no-browser]

The splat is copied with a little noise until it has so many Gaussians. A Chromium on the path draws with SwiftShader,
as tests do; a graphics card takes none of the seconds of its drawing.
"""

import argparse
import http.client
import json
import shutil
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.app.scenes import queried_scene
from gsencoder.fusion.folder import load_features
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.page.page import load_bundle, scene_container, served_page
from gsencoder.infer.page.search import SceneSearch, drawn_scene, rows_of_features
from gsencoder.infer.page.server import ViewServer

WORDS = ("mug", "chair", "table", "window", "book")
SCRIPT = """async (words) => {
  const app = gsencoderViewer, [shown] = app.shown, ms = {frame: [], ask: [], paint: [], boxes: [], pick: []};
  for (let k = 0; k < 5; k++) { app.controls.turn(0.02, 0); await app.frame(); ms.frame.push(app.frames.last); }
  app.dirty = shown.pane.dirty = () => {};  // what follows is the script alone
  app.mode = "word";
  const timed = async (name, work) => {
    const begin = performance.now();
    await work();
    ms[name].push(performance.now() - begin);
  };
  for (const word of words) {
    await timed("ask", async () => { shown.answer = await shown.answers.ask(word); shown.judged = null; });
    await timed("paint", () => app.repaint());
    await timed("boxes", () => app.searchBoxes());
    await timed("pick", () => shown.pane.pickAt(300, 300));
  }
  return ms;
}"""


def enlarged(folder: Path, count: int) -> SceneSearch:
    """The scene of a folder with so many Gaussians."""
    scene, words = queried_scene(load_features(folder), folder)
    assert scene.gaussians is not None
    ((name, features),) = scene.features.items()
    rng = np.random.default_rng(0)
    rows = np.sort(rng.choice(len(scene.gaussians), count, replace=count > len(scene.gaussians)))
    gaussians = scene.gaussians.select(rows)
    means = gaussians.means + rng.normal(0, 0.2, gaussians.means.shape) * np.median(gaussians.scales)
    gaussians = replace(gaussians, means=means.astype(np.float32), scales=0.6 * gaussians.scales)
    scene = replace(scene, gaussians=gaussians, features={name: rows_of_features(features, rows)})
    return SceneSearch(shown=drawn_scene(scene, "a", max_gaussians=count), words=words, config=LocalizeConfig())


def ask(server: ViewServer, word: str) -> tuple[float, int]:
    """Milliseconds and bytes of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1])
    start = time.perf_counter()
    body = json.dumps({"scene": 0, "word": word})
    connection.request("POST", f"/{server.token}/ask", body, {"Content-Type": "application/json"})
    data = connection.getresponse().read()
    return 1000 * (time.perf_counter() - start), len(data)


def in_browser(server: ViewServer) -> dict[str, float]:
    """Prints and returns the milliseconds of the page's script, and of its frames."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        flags = ["--no-sandbox", "--enable-unsafe-swiftshader"]
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(300_000)
        page.goto(server.address)
        page.wait_for_selector("body[data-state=ready]")
        found = page.evaluate(SCRIPT, list(WORDS))
        for name, values in found.items():
            print(f"browser, {name}: median {np.median(values):.0f} ms of {[round(value) for value in values]}")
        browser.close()
    return {name: float(np.median(values)) for name, values in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("features", type=Path)
    parser.add_argument("--gaussians", type=int, default=500_000)
    parser.add_argument("--no-browser", action="store_true")
    add_json_option(parser)
    options = parser.parse_args()
    search = enlarged(options.features, options.gaussians)
    page = served_page(load_bundle(), "bench", {"kind": "server", "scenes": 1, "notes": []})
    with ViewServer(page, [search], [scene_container(search, ())]) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        answers = [ask(server, word) for word in WORDS]
        print(f"{options.gaussians:,} Gaussians, {answers[0][1]:,} bytes an answer")
        print(f"server: {[round(milliseconds) for milliseconds, _ in answers]} ms")
        figures = {"bytes": answers[0][1], "server": float(np.median([each for each, _ in answers]))}
        if not options.no_browser:
            figures |= in_browser(server)
        write_figures(options.json, figures)
        server.shutdown()
        thread.join()


if __name__ == "__main__":
    main()
