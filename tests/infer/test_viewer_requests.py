"""What a request to the server of `view` may hold: both scenes, both ends of each range, and connections that end."""

import io
import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from viewed_rooms import STUB, room_scene, save_viewed_room, search_of
from viewer_containers import read_container
from viewer_requests import at, call, head, sent

from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.page import server as viewer_server
from gsencoder.infer.page.page import scene_container, served_page
from gsencoder.infer.page.search import RELEVANCY_STEP, UNSEEN, SceneSearch
from gsencoder.infer.page.server import MAX_BODY, MAX_ROWS, MAX_WORD, ViewServer
from gsencoder.infer.relevancy import ThresholdConfig

JSON = {"Content-Type": "application/json"}


@contextmanager
def running(searches: list[SceneSearch], **options: Any) -> Iterator[ViewServer]:
    page = served_page(STUB, "room", {"kind": "server", "scenes": len(searches), "notes": []})
    with ViewServer(page, searches, [scene_container(each, ()) for each in searches], **options) as made:
        thread = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield made
        made.shutdown()
        thread.join()


@pytest.fixture(scope="module")
def searches(tmp_path_factory: pytest.TempPathFactory) -> list[SceneSearch]:
    """A scene with photographs, and one of fewer Gaussians without any."""
    folder = tmp_path_factory.mktemp("requests")
    save_viewed_room(folder)
    first = search_of(folder / "features")
    first.shown = replace(first.shown, scene=replace(first.shown.scene, views=room_scene().views))
    second = search_of(folder / "features", max_gaussians=2000)
    second.shown = replace(second.shown, scene=replace(second.shown.scene, views=None))
    second.config = LocalizeConfig(threshold=ThresholdConfig(kind="fixed", fixed=0.37))
    return [first, second]


@pytest.fixture(scope="module")
def server(searches: list[SceneSearch]) -> Iterator[ViewServer]:
    with running(searches) as made:
        yield made


def test_each_scene_is_answered_under_its_own_number(server: ViewServer, searches: list[SceneSearch]) -> None:
    for number, search in enumerate(searches):
        count = len(search.shown.gaussians)
        assert read_container(call(server, "GET", at(server, f"scene/{number}"))[1]).meta["count"] == count
        labels = read_container(call(server, "GET", at(server, f"labels/{number}"))[1])
        np.testing.assert_array_equal(labels.arrays["numbers"], search.labels().numbers)
        answer = read_container(call(server, "POST", at(server, "ask"), {"scene": number, "word": "mug"})[1])
        expected = search.ask("mug")
        np.testing.assert_array_equal(answer.arrays["relevancy"], expected.relevancy)
        assert (answer.arrays["relevancy"] == UNSEEN).any()
        assert answer.meta == {
            "word": "mug", "threshold": pytest.approx(expected.threshold), "step": RELEVANCY_STEP, "unseen": UNSEEN,
        }  # fmt: skip


def test_photographs_come_whole_and_a_scene_without_any_says_so(server: ViewServer) -> None:
    photographs = room_scene().views
    assert photographs is not None
    assert photographs.images is not None
    for view in (0, 4):
        with Image.open(io.BytesIO(call(server, "GET", at(server, f"photograph/0/{view}"))[1])) as picture:
            assert picture.size == (96, 72)
            errors = [np.abs(np.asarray(picture, float) - each).mean() for each in photographs.images]
        assert int(np.argmin(errors)) == view
    status, data, _ = call(server, "GET", at(server, "photograph/1/0"))
    assert (status, json.loads(data)["error"]) == (404, "the scene has no photographs")


@pytest.mark.parametrize("scene", [False, True, 2, -1, 0.0, None, [0]])
def test_what_is_no_number_of_a_scene_is_refused(server: ViewServer, scene: Any) -> None:
    assert call(server, "POST", at(server, "ask"), {"scene": scene, "word": "mug"})[0] == 400


def test_what_is_as_large_as_it_may_be_is_answered(server: ViewServer, searches: list[SceneSearch]) -> None:
    count = len(searches[0].shown.gaussians)
    # Nobody knows the word, but it is one.
    assert call(server, "POST", at(server, "ask"), {"scene": 0, "word": "x" * MAX_WORD})[0] == 422
    for rows, status in (([count - 1] * MAX_ROWS, 200), ([count], 400), ([0, -1], 400)):
        assert call(server, "POST", at(server, "words"), {"scene": 0, "rows": rows})[0] == status
    question = json.dumps({"scene": 0, "word": "mug"}).encode()
    assert call(server, "POST", at(server, "ask"), question.ljust(MAX_BODY))[0] == 200


def test_blanks_around_a_word_and_after_the_kind_of_a_body_do_not_matter(server: ViewServer) -> None:
    kind = {"Content-Type": "Application/JSON ; charset=utf-8"}
    status, data, _ = call(server, "POST", at(server, "boxes"), {"scene": 0, "word": " mug\n"}, headers=kind)
    assert status == 200
    assert {box["query"] for box in json.loads(data)["boxes"]} == {"mug"}
    assert call(server, "GET", at(server, "") + "?again")[0] == 200


def test_the_pages_own_questions_have_its_origin(server: ViewServer) -> None:
    port = server.server_address[1]
    for origin, status in ((f"http://127.0.0.1:{port}", 200), (f"https://127.0.0.1:{port}", 403), ("null", 403)):
        answer = call(server, "POST", at(server, "boxes"), {"scene": 0, "word": "mug"}, headers={"Origin": origin})
        assert answer[0] == status


@pytest.mark.parametrize("rest", ["", "scene/0", "nowhere"])
def test_answers_stay_with_the_page(server: ViewServer, rest: str) -> None:
    headers = call(server, "GET", at(server, rest))[2]
    expected = {
        "Cache-Control": "no-store", "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer",
        "Cross-Origin-Resource-Policy": "same-origin", "X-Frame-Options": "DENY",
    }  # fmt: skip
    assert {name: headers[name] for name in expected} == expected
    assert ("Content-Security-Policy" in headers) == (rest == "")


def test_a_part_of_the_token_is_another_token(server: ViewServer) -> None:
    for path in (f"/{server.token[:-1]}/", f"/{server.token}x/", f"/{server.token[1:]}/"):
        assert call(server, "GET", path)[0] == 403


def test_a_body_that_was_refused_is_not_taken_for_the_next_request(server: ViewServer) -> None:
    hidden = head(server, "GET", "scene/0")
    lines = ("Content-Type: text/plain", f"Content-Length: {len(hidden)}")
    answer = sent(server, head(server, "POST", "ask", *lines) + hidden)
    assert answer.startswith(b"HTTP/1.1 415")
    assert answer.count(b"HTTP/1.1") == 1
    assert b"\r\nConnection: close\r\n" in answer


def test_a_connection_answers_one_request_after_another(server: ViewServer) -> None:
    twice = head(server, "GET", "labels/1") + head(server, "GET", "labels/1", "Connection: close")
    assert sent(server, twice).count(b"HTTP/1.1 200") == 2


@pytest.mark.parametrize(
    ("lines", "status"),
    [
        (("Content-Type: application/json",), b"411"),
        (("Content-Type: application/json", "Content-Length: 1e3"), b"411"),
        (("Content-Type: application/json", f"Content-Length: {'9' * 5000}"), b"413"),
        (("Content-Length: 2",), b"415"),
    ],
)
def test_a_length_is_a_number_and_not_too_large(server: ViewServer, lines: tuple[str, ...], status: bytes) -> None:
    assert sent(server, head(server, "POST", "ask", *lines)).split()[1] == status


def test_a_body_that_does_not_come_is_waited_for_and_then_refused(
    server: ViewServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert 0 < viewer_server.TIMEOUT <= 60
    monkeypatch.setattr(viewer_server, "TIMEOUT", 0.2)
    lines = ("Content-Type: application/json", "Content-Length: 10")
    assert sent(server, head(server, "POST", "ask", *lines)).startswith(b"HTTP/1.1 400")
    assert sent(server, "") == b""


def test_another_address_has_its_own_name_alone(searches: list[SceneSearch]) -> None:
    try:
        with socket.create_server(("127.0.0.2", 0)):
            pass
    except OSError:
        pytest.skip("there is no second address of this machine")
    with running(searches[:1], host="127.0.0.2") as server:
        port = server.server_address[1]
        assert server.address == f"http://127.0.0.2:{port}/{server.token}/"
        for host, status in (("127.0.0.2", 200), ("127.0.0.1", 403), ("localhost", 403)):
            assert call(server, "GET", at(server, ""), headers={"Host": f"{host}:{port}"})[0] == status


def test_an_address_of_version_six_stands_in_brackets(searches: list[SceneSearch]) -> None:
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6):
            pass
    except OSError:
        pytest.skip("this machine has no IPv6")
    with running(searches[:1], host="::1") as server:
        port = server.server_address[1]
        assert server.address == f"http://[::1]:{port}/{server.token}/"
        assert call(server, "GET", at(server, ""), headers={"Host": f"[::1]:{port}"})[0] == 200
        assert call(server, "GET", at(server, ""), headers={"Host": f"::1:{port}"})[0] == 403
