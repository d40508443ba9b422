"""The HTML of a page, and how much of a scene goes into a file of a given size."""

import base64
import gzip
import hashlib
import re
from dataclasses import replace
from functools import cache
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from viewed_rooms import STUB, room_scene, save_viewed_room, search_of
from viewer_containers import read_container

from gsencoder.core.errors import InputError
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.page.page import (
    SCRIPT,
    STYLE,
    Bundle,
    Container,
    FileOptions,
    MadePage,
    file_page,
    fitting_page,
    load_bundle,
    served_page,
)
from gsencoder.infer.page.search import SceneSearch
from gsencoder.types import Scene

OPTIONS = FileOptions(error=0.01, sh_degree=3, photographs=2, photograph_side=64)
room = cache(room_scene)
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
        assert match is not None
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


def test_titles_that_no_encoding_knows_become_question_marks() -> None:
    title = "a\ud800b"
    assert b"<title>a?b</title>" in served_page(STUB, title, SETTINGS)[0]
    assert b"<title>a?b</title>" in file_page(STUB, title, SETTINGS, [])


def test_a_page_of_the_same_scene_is_the_same_whenever_it_is_written() -> None:
    page = file_page(STUB, "a", SETTINGS, [Container(meta={}, arrays={})]).decode()
    match = re.search(r'id="scene-0">([^<]+)<', page)
    assert match is not None
    # The time in the header of gzip.
    assert base64.b64decode(match[1])[4:8] == bytes(4)


@pytest.mark.parametrize("broken", [SCRIPT, STYLE])
def test_a_bundle_that_cannot_be_read_is_one_line(tmp_path: Path, broken: str) -> None:
    for name in (SCRIPT, STYLE):
        (tmp_path / name).mkdir() if name == broken else (tmp_path / name).write_text("")
    with pytest.raises(InputError, match=f"{broken}.*make viewer"):
        load_bundle(tmp_path)


@pytest.fixture(scope="module")
def search(tmp_path_factory: pytest.TempPathFactory) -> SceneSearch:
    made = tmp_path_factory.mktemp("sizes")
    save_viewed_room(made)
    return search_of(made / "features")


def colored(scene: Scene, degree: int) -> Scene:
    assert scene.gaussians is not None
    sh = np.random.default_rng(1).normal(size=(len(scene.gaussians), (degree + 1) ** 2, 3)) * 0.1
    return replace(scene, gaussians=replace(scene.gaussians, sh=sh.astype(np.float32)))


def fitted(search: SceneSearch, limit: int, *degrees: int, options: FileOptions = OPTIONS, **further: int) -> MadePage:
    scenes = [(colored(search.shown.scene, degree), f"t{degree}", search.words) for degree in degrees]
    limits = {"max_gaussians": 10**6, "max_bytes": limit} | further
    return fitting_page(STUB, scenes, LocalizeConfig(), room().objects, options, **limits)


def scenes_of(made: MadePage) -> list[Container]:
    matches = re.findall(r'id="scene-\d+">([^<]+)<', made.page.decode())
    return [read_container(gzip.decompress(base64.b64decode(blob))) for blob in matches]


def test_a_page_holds_all_up_to_its_last_byte_and_says_what_it_knows(search: SceneSearch) -> None:
    whole = fitted(search, 10**7, 1)
    count = len(search.shown.gaussians)
    assert (whole.sh_degree, whole.gaussians) == ((1,), (count,))
    assert whole.notes[0] == f"This file knows {len(search.words.names)} words."
    assert any("were seen by no view" in note for note in whole.notes)
    assert fitted(search, len(whole.page), 1).page == whole.page
    less = fitted(search, len(whole.page) - 1, 1)
    assert less.sh_degree == (0,)
    assert f"larger than {(len(whole.page) - 1) / 1e6:g} MB (megabytes=) keeps them" in less.notes[0]
    (scene,) = scenes_of(whole)
    assert scene.meta["objects"] == [each.name or "" for each in room().objects]
    assert scene.meta["title"] == "t1"


def test_harmonics_are_those_of_the_richest_scene_up_to_the_option(search: SceneSearch) -> None:
    both = fitted(search, 10**7, 0, 2)
    assert both.sh_degree == (0, 2)
    assert not any("harmonics" in note for note in both.notes)
    assert [scene.meta["title"] for scene in scenes_of(both)] == ["t0", "t2"]
    capped = fitted(search, 10**7, 0, 2, options=replace(OPTIONS, sh_degree=1))
    assert capped.sh_degree == (0, 1)
    assert any("above degree 1 of 2 are left out" in note for note in capped.notes)


def test_a_thinned_page_uses_most_of_its_size_whatever_was_asked_for(search: SceneSearch) -> None:
    whole = fitted(search, 10**7, 0)
    limit = len(whole.page) // 2
    for most in (10**6, len(search.shown.gaussians)):
        made = fitted(search, limit, 0, max_gaussians=most)
        assert 0.6 * limit < len(made.page) <= limit
        assert any("megabytes= or max_gaussians= takes more" in note for note in made.notes)
    tight = fitted(search, len(whole.page), 0, max_gaussians=1500)
    assert tight.gaussians == (1500,)
    with pytest.raises(InputError, match="not even 1,000 Gaussians fit beside the page itself, which takes 0.0 MB;"):
        fitted(search, len(whole.page) // 8, 0)


def test_photographs_are_counted_as_they_are_in_the_file(search: SceneSearch) -> None:
    scene = replace(search.shown.scene, views=room().views)
    for photographs, count in ((0, 0), (2, 2), (9, 6)):
        made = fitting_page(
            STUB, [(scene, "t", search.words)], LocalizeConfig(), (), replace(OPTIONS, photographs=photographs),
            max_gaussians=1500, max_bytes=10**7,
        )  # fmt: skip
        assert made.photographs == (count,)
        assert scenes_of(made)[0].meta["photographs"] is (count > 0)
