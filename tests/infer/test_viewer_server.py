"""The server of `view` answers its own page, and nothing and nobody else."""

import http.client
import json
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from viewed_rooms import STUB, room_scene, save_viewed_room, search_of
from viewer_containers import read_container
from viewer_requests import at, call, connected, head

from gsencoder.core.errors import InputError
from gsencoder.infer.page import server as viewer_server
from gsencoder.infer.page.page import scene_container, served_page
from gsencoder.infer.page.search import SceneSearch
from gsencoder.infer.page.server import MAX_BODY, MAX_ROWS, ViewServer


@pytest.fixture(scope="module")
def search(tmp_path_factory: pytest.TempPathFactory) -> SceneSearch:
    folder = tmp_path_factory.mktemp("served")
    save_viewed_room(folder)
    search = search_of(folder / "features")
    search.shown = replace(search.shown, scene=replace(search.shown.scene, views=room_scene().views))
    return search


@pytest.fixture(scope="module")
def server(search: SceneSearch) -> Iterator[ViewServer]:
    page = served_page(STUB, "room", {"kind": "server", "scenes": 1, "notes": []})
    with ViewServer(page, [search], [scene_container(search, ())]) as made:
        thread = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield made
        made.shutdown()
        thread.join()


def test_the_page_comes_with_a_policy_that_allows_its_own_script_alone(server: ViewServer) -> None:
    status, page, headers = call(server, "GET", at(server, ""))
    assert status == 200
    assert page == server.page[0]
    assert headers["Content-Security-Policy"] == server.page[1]
    assert headers["Cache-Control"] == "no-store"
    assert headers["X-Frame-Options"] == "DENY"


def test_a_scene_comes_as_its_container(server: ViewServer, search: SceneSearch) -> None:
    status, data, _ = call(server, "GET", at(server, "scene/0"))
    assert status == 200
    assert read_container(data).meta["count"] == len(search.shown.gaussians)


def test_a_word_is_answered_with_the_relevancy_of_all_gaussians(server: ViewServer, search: SceneSearch) -> None:
    status, data, _ = call(server, "POST", at(server, "ask"), {"scene": 0, "word": " mug "})
    assert status == 200
    np.testing.assert_array_equal(read_container(data).arrays["relevancy"], search.ask("mug").relevancy)


def test_boxes_words_labels_and_photographs_are_answered(server: ViewServer) -> None:
    status, data, _ = call(server, "POST", at(server, "boxes"), {"scene": 0, "word": "mug"})
    assert status == 200
    assert json.loads(data)["boxes"][0]["query"] == "mug"
    status, data, _ = call(server, "POST", at(server, "words"), {"scene": 0, "rows": [0, 1, 2]})
    assert status == 200
    assert json.loads(data)["words"][0][0] == "room"
    status, data, _ = call(server, "GET", at(server, "labels/0"))
    assert "mug" in read_container(data).meta["names"]
    status, data, headers = call(server, "GET", at(server, "photograph/0/3"))
    assert (status, headers["Content-Type"], data[:2]) == (200, "image/jpeg", b"\xff\xd8")


@pytest.mark.parametrize("word", ["banjo", "‮tub", "<script>alert(1)</script>"])
def test_an_unknown_word_is_a_sentence_and_no_page(server: ViewServer, word: str) -> None:
    status, data, headers = call(server, "POST", at(server, "ask"), {"scene": 0, "word": word})
    assert status == 422
    assert headers["Content-Type"] == "application/json"
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert "not among" in json.loads(data)["error"]


@pytest.mark.parametrize("path", ["/", "/wrong/", "/wrong/scene/0", "//scene/0", "/%20/", "/tökén/"])
def test_another_token_is_refused(server: ViewServer, path: str) -> None:
    assert call(server, "GET", path)[0] == 403


def test_a_token_in_another_case_is_refused(server: ViewServer) -> None:
    assert call(server, "GET", f"/{server.token.swapcase()}/")[0] == 403


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "127.0.0.1:1", "localhost:80", "", "127.0.0.1.evil:80"])
def test_another_host_header_is_refused_even_with_the_token(server: ViewServer, host: str) -> None:
    assert call(server, "GET", at(server, ""), headers={"Host": host})[0] == 403


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "LOCALHOST"])
def test_names_of_this_machine_are_taken(server: ViewServer, host: str) -> None:
    port = server.server_address[1]
    assert call(server, "GET", at(server, ""), headers={"Host": f"{host}:{port}"})[0] == 200


def test_a_request_of_another_site_is_refused(server: ViewServer) -> None:
    headers = {"Origin": "https://evil.example"}
    assert call(server, "POST", at(server, "ask"), {"scene": 0, "word": "mug"}, headers=headers)[0] == 403


@pytest.mark.parametrize(
    "rest",
    [
        "../../etc/passwd",
        "..%2f..%2fetc/passwd",
        "scene/../0",
        "scene/1",
        "scene/-1",
        "scene/0/",
        "scene/٣",
        "photograph/0/6",
        "photograph/0/../../x",
        "photograph/9/0",
        "static/viewer.js",
        "summary.json",
        "scene/99999999999999999999",
    ],
)
def test_paths_that_are_not_listed_lead_nowhere(server: ViewServer, rest: str) -> None:
    status, data, headers = call(server, "GET", at(server, rest))
    assert status in (400, 404, 422)
    assert headers["Content-Type"] == "application/json"
    assert b"root:" not in data


@pytest.mark.parametrize(
    ("body", "status"),
    [
        (b"", 400),
        (b"\xff\xfe garbage", 400),
        (b"[" * 30_000, 400),
        (b"[]", 400),
        (b"null", 400),
        ({"scene": 0}, 400),
        ({"scene": 0, "word": ""}, 400),
        ({"scene": 0, "word": 7}, 400),
        ({"scene": 0, "word": "x" * 501}, 400),
        ({"scene": 2, "word": "mug"}, 400),
        ({"scene": True, "word": "mug"}, 400),
        ({"scene": "0", "word": "mug"}, 400),
        (b" " * (MAX_BODY + 1), 413),
    ],
)
def test_bodies_that_are_no_question_are_refused(server: ViewServer, body: Any, status: int) -> None:
    assert call(server, "POST", at(server, "ask"), body)[0] == status


@pytest.mark.parametrize("rows", [None, [], [-1], [10**9], ["0"], [True], [0.5], [0] * (MAX_ROWS + 1), {"0": 1}])
def test_rows_that_are_no_gaussians_are_refused(server: ViewServer, rows: Any) -> None:
    assert call(server, "POST", at(server, "words"), {"scene": 0, "rows": rows})[0] == 400


def test_a_body_of_another_kind_is_refused(server: ViewServer) -> None:
    headers = {"Content-Type": "text/plain"}
    assert call(server, "POST", at(server, "ask"), {"scene": 0, "word": "mug"}, headers=headers)[0] == 415


def test_megabytes_are_refused_before_they_are_read(server: ViewServer) -> None:
    with socket.create_connection(("127.0.0.1", server.server_address[1]), timeout=10) as stream:
        port = server.server_address[1]
        stream.sendall(
            f"POST {at(server, 'ask')} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Type: application/json\r\n"
            f"Content-Length: {10**11}\r\n\r\n".encode()
        )
        assert stream.recv(64).startswith(b"HTTP/1.1 413")


@pytest.mark.parametrize("length", ["", "-5", "1e3", "٣", "999999999999999999999"])
def test_a_length_that_is_no_number_is_refused(server: ViewServer, length: str) -> None:
    with socket.create_connection(("127.0.0.1", server.server_address[1]), timeout=10) as stream:
        port = server.server_address[1]
        stream.sendall(
            f"POST {at(server, 'ask')} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Type: application/json\r\n"
            f"Content-Length: {length}\r\n\r\n".encode()
        )
        assert stream.recv(64).split()[1] in (b"411", b"413")


@pytest.mark.parametrize("method", ["HEAD", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE"])
def test_other_methods_are_refused_after_the_token(server: ViewServer, method: str) -> None:
    status, _, headers = call(server, method, at(server, ""))
    assert (status, headers["Allow"]) == (405, "GET, POST")
    assert call(server, method, "/wrong/")[0] == 403


def test_a_port_in_use_is_one_line_that_says_so(server: ViewServer, search: SceneSearch) -> None:
    with pytest.raises(InputError, match="port=0 takes a free one"):
        ViewServer(server.page, [search], [], port=server.server_address[1])


def test_each_server_has_a_token_of_its_own(server: ViewServer, search: SceneSearch) -> None:
    with ViewServer(server.page, [search], []) as other:
        assert other.token != server.token
        assert len(other.token) >= 32
        assert other.server_address[0] == "127.0.0.1"


def test_questions_from_many_threads_have_their_own_answers(server: ViewServer, search: SceneSearch) -> None:
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
        np.testing.assert_array_equal(answers[number], search.ask(word).relevancy)


def test_a_request_that_comes_byte_by_byte_is_ended(server: ViewServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer_server, "TIMEOUT", 0.4)
    for text in ("G" * 100, head(server, "POST", "ask", "Content-Type: application/json", "Content-Length: 99") + "{"):
        with connected(server) as stream:
            begun = time.monotonic()
            with suppress(ConnectionError):
                stream.sendall(text.encode())
                while time.monotonic() - begun < 5:
                    time.sleep(0.05)
                    stream.sendall(b"G")
            assert 0.3 < time.monotonic() - begun < 4
    # A request that is there in time is answered, whatever its answer takes.
    assert call(server, "GET", at(server, ""))[0] == 200


def test_strangers_take_no_place_from_the_page(server: ViewServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer_server, "MAX_CONNECTIONS", 8)
    threads = threading.active_count()
    request = head(server, "GET", "").encode()
    with ExitStack() as strangers, connected(server) as page:
        for _ in range(2):
            page.sendall(request)
            answer = b""
            while server.page[0] not in answer:
                part = page.recv(1 << 16)
                assert part
                answer += part
            for _ in range(30):
                strangers.enter_context(connected(server))
        assert call(server, "GET", at(server, ""))[0] == 200
        # A thread ends a moment after its connection was shut down.
        until = time.monotonic() + 10
        while threading.active_count() > threads + 9 and time.monotonic() < until:
            time.sleep(0.01)
        assert threading.active_count() <= threads + 9


def test_a_request_that_has_come_is_not_ended_while_it_is_answered(
    server: ViewServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, now = ViewServer.search_of, time.monotonic

    def slow(made: ViewServer, value: Any) -> SceneSearch:
        with monkeypatch.context() as later:
            later.setattr(viewer_server, "time", SimpleNamespace(monotonic=lambda: now() + 1000))
            made.service_actions()
        return real(made, value)

    monkeypatch.setattr(ViewServer, "search_of", slow)
    body = json.dumps({"scene": 0, "rows": [0]})
    lines = ("Content-Type: application/json", f"Content-Length: {len(body)}")
    with connected(server) as stream:
        for text in (head(server, "GET", "labels/0"), head(server, "POST", "words", *lines) + body) * 2:
            stream.sendall(text.encode())
            response = http.client.HTTPResponse(stream)
            response.begin()
            assert (response.status, bool(response.read())) == (200, True)
            time.sleep(0.03)


def test_where_too_many_wait_those_are_ended_that_came_first_of_those_without_the_token(
    search: SceneSearch, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(viewer_server, "MAX_CONNECTIONS", 3)
    with ExitStack() as stack:
        idle = stack.enter_context(ViewServer((b"", ""), [search], []))
        ends = [stack.enter_context(end) for _ in range(5) for end in socket.socketpair()][::2]
        for end in ends:
            end.setblocking(False)

        def is_ended(end: socket.socket) -> bool:
            try:
                return end.recv(1) == b""
            except BlockingIOError:
                return False

        def ended() -> list[int]:
            return [number for number, end in enumerate(ends) if is_ended(end)]

        for number in range(5):
            idle.wait_for(ends[number], number in (0, 3))
            idle.service_actions()
            assert ended() == ([], [], [], [1], [1, 2])[number]
        idle.has_come(ends[3])
        idle.service_actions()
        assert ended() == [1, 2]
        now = time.monotonic
        monkeypatch.setattr(viewer_server, "time", SimpleNamespace(monotonic=lambda: now() + viewer_server.TIMEOUT))
        idle.service_actions()
        assert ended() == [0, 1, 2, 4]


def test_a_client_that_resets_its_connection_prints_nothing(
    server: ViewServer, capfd: pytest.CaptureFixture[str]
) -> None:
    for text in ("", "GET / HT", head(server, "GET", "scene/0")):
        stream = connected(server)
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        stream.sendall(text.encode())
        stream.close()
    time.sleep(0.2)
    assert call(server, "GET", at(server, ""))[0] == 200
    assert capfd.readouterr().err == ""
