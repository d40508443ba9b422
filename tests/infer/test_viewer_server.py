"""The server of `view` answers its own page, and nothing and nobody else."""

import http.client
import io
import json
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from viewed_rooms import STUB, read_container, room_scene, save_viewed_room, search_of

from gsencoder.core.errors import InputError
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.page import server as viewer_server
from gsencoder.infer.page.page import scene_container, served_page
from gsencoder.infer.page.search import RELEVANCY_STEP, UNSEEN, SceneSearch
from gsencoder.infer.page.server import MAX_BODY, MAX_ROWS, MAX_WORD, ViewServer
from gsencoder.infer.relevancy import ThresholdConfig


class Connection(http.client.HTTPConnection):
    """Sends any letters of a path, which the library refuses."""

    def _encode_request(self, request: str) -> bytes:
        return request.encode("utf-8")


def call(
    server: ViewServer, method: str, path: str, body: Any = None, *, headers: dict[str, str] | None = None
) -> tuple[int, bytes, http.client.HTTPMessage]:
    """An answer to a request to a path behind the token; a body that is no bytes is sent as JSON."""
    connection = Connection(server.server_address[0], server.server_address[1], timeout=10)
    data = body if isinstance(body, bytes) or body is None else json.dumps(body).encode()
    sent = {"Content-Type": "application/json"} if data is not None else {}
    connection.request(method, path, data, sent | (headers or {}))
    response = connection.getresponse()
    read = response.read()
    connection.close()
    return response.status, read, response.headers


def at(server: ViewServer, rest: str) -> str:
    return f"/{server.token}/{rest}"


def connected(server: ViewServer) -> socket.socket:
    """A connection on which nothing was sent."""
    return socket.create_connection((str(server.server_address[0]), server.server_address[1]), timeout=10)


def sent(server: ViewServer, text: str) -> bytes:
    """All that comes back for the bytes of a request, until the server closes the connection."""
    with connected(server) as stream:
        stream.sendall(text.encode())
        parts = []
        while part := stream.recv(1 << 16):
            parts.append(part)
    return b"".join(parts)


def head(server: ViewServer, method: str, rest: str, *lines: str) -> str:
    """The lines of a request before its body."""
    host, port = server.server_address[:2]
    return "\r\n".join([f"{method} {at(server, rest)} HTTP/1.1", f"Host: {host}:{port}", *lines, "", ""])


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
    first.display = replace(first.display, scene=replace(first.display.scene, views=room_scene().views))
    second = search_of(folder / "features", max_gaussians=2000)
    second.display = replace(second.display, scene=replace(second.display.scene, views=None))
    second.config = LocalizeConfig(threshold=ThresholdConfig(kind="fixed", fixed=0.37))
    return [first, second]


@pytest.fixture(scope="module")
def server(searches: list[SceneSearch]) -> Iterator[ViewServer]:
    with running(searches) as made:
        yield made


def test_each_scene_is_answered_under_its_own_number(server: ViewServer, searches: list[SceneSearch]) -> None:
    for number, search in enumerate(searches):
        count = len(search.display.gaussians)
        assert read_container(call(server, "GET", at(server, f"scene/{number}"))[1]).meta["count"] == count
        labels = read_container(call(server, "GET", at(server, f"labels/{number}"))[1])
        np.testing.assert_array_equal(labels.arrays["numbers"], search.labels.numbers)
        answer = read_container(call(server, "POST", at(server, "ask"), {"scene": number, "word": "mug"})[1])
        expected = search.ask("mug")
        np.testing.assert_array_equal(answer.arrays["relevancy"], expected.relevancy)
        assert (answer.arrays["relevancy"] == UNSEEN).any()
        assert answer.meta == {
            "word": "mug", "threshold": pytest.approx(expected.threshold), "step": RELEVANCY_STEP, "unseen": UNSEEN,
        }  # fmt: skip


def test_photographs_come_whole_and_a_scene_without_any_says_so(server: ViewServer) -> None:
    photographs = room_scene().views
    for view in (0, 4):
        with Image.open(io.BytesIO(call(server, "GET", at(server, f"photograph/0/{view}"))[1])) as picture:
            assert picture.size == (96, 72)
            errors = [np.abs(np.asarray(picture, float) - each).mean() for each in photographs.images]
        assert int(np.argmin(errors)) == view
    status, data, _ = call(server, "GET", at(server, "photograph/1/0"))
    assert (status, json.loads(data)["error"]) == (422, "the scene has no photographs")


@pytest.mark.parametrize("scene", [True, 2, -1, 0.0, None])
def test_what_is_no_number_of_a_scene_is_refused(server: ViewServer, scene: Any) -> None:
    assert call(server, "POST", at(server, "ask"), {"scene": scene, "word": "mug"})[0] == 400


def test_what_is_as_large_as_it_may_be_is_answered(server: ViewServer, searches: list[SceneSearch]) -> None:
    count = len(searches[0].display.gaussians)
    # Nobody knows the word, but it is one.
    assert call(server, "POST", at(server, "ask"), {"scene": 0, "word": "x" * MAX_WORD})[0] == 422
    for rows, status in (([count - 1] * MAX_ROWS, 200), ([count], 400), ([0, -1], 400)):
        assert call(server, "POST", at(server, "words"), {"scene": 0, "rows": rows})[0] == status
    question = json.dumps({"scene": 0, "word": "mug"}).encode()
    assert call(server, "POST", at(server, "ask"), question.ljust(MAX_BODY))[0] == 200


def test_the_pages_own_questions_have_its_origin(server: ViewServer) -> None:
    port = server.server_address[1]
    for origin, status in ((f"http://127.0.0.1:{port}", 200), (f"https://127.0.0.1:{port}", 403), ("null", 403)):
        answer = call(server, "POST", at(server, "boxes"), {"scene": 0, "word": "mug"}, headers={"Origin": origin})
        assert answer[0] == status


def test_boxes_come_at_a_threshold_and_words_for_gaussians(server: ViewServer, searches: list[SceneSearch]) -> None:
    for question, cutoff in (({}, None), ({"threshold": None}, None), ({"threshold": 0.3}, 0.3)):
        status, data, _ = call(server, "POST", at(server, "boxes"), {"scene": 0, "word": "mug"} | question)
        assert (status, json.loads(data)) == (200, searches[0].boxes("mug", cutoff))
    for wrong in (2, -1.5, "0.3", [0]):
        question = {"scene": 0, "word": "mug", "threshold": wrong}
        assert call(server, "POST", at(server, "boxes"), question)[0] == 400
    status, data, _ = call(server, "POST", at(server, "words"), {"scene": 0, "rows": [0, 1, 2]})
    assert (status, json.loads(data)["words"][0][0]) == (200, "room")


@pytest.mark.parametrize("rest", ["", "scene/0", "nowhere"])
def test_answers_stay_with_the_page(server: ViewServer, rest: str) -> None:
    _, page, headers = call(server, "GET", at(server, rest))
    expected = {
        "Cache-Control": "no-store", "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer",
        "Cross-Origin-Resource-Policy": "same-origin", "X-Frame-Options": "DENY",
    }  # fmt: skip
    assert {name: headers[name] for name in expected} == expected
    assert headers["Content-Security-Policy"] == (server.page[1] if rest == "" else None)
    assert (page == server.page[0]) == (rest == "")


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


def test_a_length_is_a_number_and_not_too_large(server: ViewServer) -> None:
    for length, status in ((), b"411"), (("1e3",), b"411"), (("9" * 5000,), b"413"), (("٣",), b"411"):
        lines = ("Content-Type: application/json", *(f"Content-Length: {each}" for each in length))
        assert sent(server, head(server, "POST", "ask", *lines)).split()[1] == status
    assert sent(server, head(server, "POST", "ask", "Content-Length: 2")).split()[1] == b"415"


def test_a_body_that_does_not_come_is_waited_for_and_then_refused(server, monkeypatch):
    assert 0 < viewer_server.TIMEOUT <= 60
    monkeypatch.setattr(viewer_server._Handler, "timeout", 0.2)
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


def test_an_unknown_word_is_a_sentence_and_no_page(server: ViewServer) -> None:
    word = "<script>alert(1)</script>"
    status, data, headers = call(server, "POST", at(server, "ask"), {"scene": 0, "word": word})
    assert status == 422
    assert headers["Content-Type"] == "application/json"
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert "not among" in json.loads(data)["error"]


def test_another_token_is_refused(server: ViewServer) -> None:
    token = server.token
    near = (f"/{token[:-1]}/", f"/{token}x/", f"/{token.swapcase()}/")
    for path in ("/", "/wrong/scene/0", "//scene/0", "/tökén/", *near):
        assert call(server, "GET", path)[0] == 403


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "127.0.0.1:1", "localhost:80", "", "127.0.0.1.evil:80"])
def test_another_host_header_is_refused_even_with_the_token(server: ViewServer, host: str) -> None:
    assert call(server, "GET", at(server, ""), headers={"Host": host})[0] == 403


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "LOCALHOST"])
def test_names_of_this_machine_are_taken(server: ViewServer, host: str) -> None:
    port = server.server_address[1]
    assert call(server, "GET", at(server, ""), headers={"Host": f"{host}:{port}"})[0] == 200


@pytest.mark.parametrize(
    "rest",
    ["../../etc/passwd", "..%2f..%2fetc/passwd", "scene/2", "scene/٣", "photograph/0/6", "scene/99999999999999999999"],
)
def test_paths_that_are_not_listed_lead_nowhere(server: ViewServer, rest: str) -> None:
    status, data, headers = call(server, "GET", at(server, rest))
    assert status in (400, 404, 422)
    assert headers["Content-Type"] == "application/json"
    assert b"root:" not in data


QUESTIONS = [{"scene": 0}, {"scene": 0, "word": 7}, {"scene": 0, "word": "x" * 501}]
BODIES = [(body, 400) for body in (b"", b"\xff\xfe garbage", b"[" * 30_000, *QUESTIONS)]


@pytest.mark.parametrize(("body", "status"), [*BODIES, (b" " * (MAX_BODY + 1), 413)])
def test_bodies_that_are_no_question_are_refused(server: ViewServer, body: Any, status: int) -> None:
    assert call(server, "POST", at(server, "ask"), body)[0] == status


@pytest.mark.parametrize("rows", [None, [], ["0"], [True], [0.5], [0] * (MAX_ROWS + 1)])
def test_rows_that_are_no_gaussians_are_refused(server: ViewServer, rows: Any) -> None:
    assert call(server, "POST", at(server, "words"), {"scene": 0, "rows": rows})[0] == 400


@pytest.mark.parametrize("method", ["HEAD", "PUT", "OPTIONS"])
def test_other_methods_are_refused_after_the_token(server: ViewServer, method: str) -> None:
    status, _, headers = call(server, method, at(server, ""))
    assert (status, headers["Allow"]) == (405, "GET, POST")
    assert call(server, method, "/wrong/")[0] == 403


def test_a_port_in_use_is_one_line_that_says_so(server: ViewServer, searches: list[SceneSearch]) -> None:
    with pytest.raises(InputError, match="port=0 takes a free one"):
        ViewServer(server.page, searches[:1], [], port=server.server_address[1])


def test_each_server_has_a_token_of_its_own(server: ViewServer, searches: list[SceneSearch]) -> None:
    with ViewServer(server.page, searches[:1], []) as other:
        assert other.token != server.token
        assert len(other.token) >= 32
        assert other.server_address[0] == "127.0.0.1"


def test_questions_from_many_threads_have_their_own_answers(server: ViewServer, searches: list[SceneSearch]) -> None:
    words = ["mug", "ball", "lamp", "bowl"] * 3
    answers: dict[int, np.ndarray] = {}

    def ask(number: int) -> None:
        _, data, _ = call(server, "POST", at(server, "ask"), {"scene": 0, "word": words[number]})
        answers[number] = read_container(data).arrays["relevancy"]

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(len(words))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for number, word in enumerate(words):
        np.testing.assert_array_equal(answers[number], searches[0].ask(word).relevancy)


def test_a_client_that_resets_its_connection_prints_nothing(server, capfd):
    for text in ("", "GET / HT", head(server, "GET", "scene/0")):
        stream = connected(server)
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        stream.sendall(text.encode())
        stream.close()
    time.sleep(0.2)
    assert call(server, "GET", at(server, ""))[0] == 200
    assert capfd.readouterr().err == ""
