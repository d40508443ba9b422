"""Replies are read within bounds, and redirects followed within one server."""

import gc
import gzip
import json
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import pytest
from chat_server import Handler, answer, completion, events, serving

from gsencoder.infer.ask import server as vlm_http
from gsencoder.infer.ask.server import (
    KEY_VARIABLE,
    MODEL_VARIABLE,
    URL_VARIABLE,
    Reply,
    ServerError,
    VlmConfig,
    VlmServer,
    request_body,
)

pytest.importorskip("openai")

PART = b"x" * (1 << 20)


@pytest.fixture(autouse=True)
def no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (URL_VARIABLE, KEY_VARIABLE, MODEL_VARIABLE):
        monkeypatch.delenv(name, raising=False)


def ask(url: str, **changed: Any) -> Reply:
    config = VlmConfig(**{"base_url": url, "model": "m", "key": "sk-1234567890", "timeout": 5.0} | changed)
    return VlmServer(config).ask(request_body([], config))


def endless(status: int, framing: str, sent: list[int], part: bytes = PART, total: int = 3 << 30) -> Any:
    """A reply of `total` bytes that counts what was sent of it."""

    def behave(handler: Handler, _: Any) -> None:
        handler.protocol_version = "HTTP/1.1"
        handler.send_response(status)
        handler.send_header("Content-Type", "text/event-stream" if part.startswith(b"data") else "application/json")
        if framing == "length":
            handler.send_header("Content-Length", str(total))
        elif framing == "chunked":
            handler.send_header("Transfer-Encoding", "chunked")
        handler.send_header("Connection", "close")
        # Before the client has the header, after which it may have refused the reply and looked at `sent`.
        sent.append(0)
        handler.end_headers()
        for _ in range(total // len(part)):
            handler.wfile.write(b"%x\r\n%s\r\n" % (len(part), part) if framing == "chunked" else part)
            sent[-1] += len(part)

    return behave


@pytest.mark.parametrize(
    ("status", "framing", "stream"),
    [
        *((200, framing, stream) for framing in ("length", "chunked", "until the end") for stream in (True, False)),
        *((status, framing, False) for status in (307, 400, 404, 500) for framing in ("length", "chunked")),
    ],
)
def test_a_reply_without_end_is_refused_once_and_mostly_unread(status: int, framing: str, stream: bool) -> None:
    sent: list[int] = []
    with (
        serving(endless(status, framing, sent)) as server,
        pytest.raises(ServerError, match="sent more than 4,718,592 bytes, which no answer needs"),
    ):
        ask(server.url, stream=stream, retries=0 if status == 500 else 2)
    assert len(sent) == 1
    assert sent[0] < 64 << 20


def test_pieces_without_end_are_refused() -> None:
    sent: list[int] = []
    chunk = {"id": "1", "object": "chat.completion.chunk", "created": 0, "model": "m"}
    part = f"data: {json.dumps(chunk | {'choices': [{'index': 0, 'delta': {'content': 'x' * 60_000}}]})}\n\n".encode()
    with serving(endless(200, "chunked", sent, part)) as server, pytest.raises(ServerError, match="sent more than"):
        ask(server.url)
    assert len(sent) == 1


def test_a_failing_server_with_a_long_page_is_asked_no_more_than_others() -> None:
    sent: list[int] = []
    with serving(endless(500, "length", sent)) as server, pytest.raises(ServerError, match="sent more than"):
        ask(server.url, retries=2)
    assert len(sent) == 1


def test_a_list_of_models_without_end_is_left_unread() -> None:
    sent: list[int] = []
    with serving(lambda handler, _: handler.reply(404, {"error": {"message": "no"}})) as server:
        server.listing = lambda handler: endless(200, "chunked", sent)(handler, None)
        with pytest.raises(ServerError, match="has no model of that name") as caught:
            ask(server.url)
    assert "it has" not in str(caught.value)
    assert len(sent) == 1
    assert sent[0] < 64 << 20


def test_a_list_of_models_that_drips_is_not_waited_for() -> None:
    def drip(handler: Handler) -> None:
        handler.send_response(200)
        handler.end_headers()
        for _ in range(30):
            handler.wfile.write(b" ")
            handler.wfile.flush()
            time.sleep(0.1)

    begun = time.monotonic()
    with serving(lambda handler, _: handler.reply(404, {"error": {"message": "no"}})) as server:
        server.listing = drip
        with pytest.raises(ServerError, match="has no model of that name"):
            ask(server.url, timeout=0.4)
        assert time.monotonic() - begun < 2.5


@pytest.mark.parametrize("stream", [True, False])
def test_an_answer_may_be_longer_where_more_tokens_are_asked_for(stream: bool) -> None:
    long = "x" * (vlm_http.LARGEST_REPLY + 1000)
    data = events(long) if stream else json.dumps(completion(long)).encode()
    kind = "text/event-stream" if stream else "application/json"
    with serving(lambda handler, _: handler.raw(200, data, kind)) as server:
        assert ask(server.url, stream=stream, max_tokens=4096).text == long
        with pytest.raises(ServerError, match="sent more than 4,195,328 bytes"):
            ask(server.url, stream=stream, max_tokens=1)


@pytest.mark.parametrize("status", [200, 400, 500])
@pytest.mark.parametrize("coding", ["gzip", "br", "gzip, gzip"])
def test_replies_are_asked_for_uncompressed_and_others_refused(status: int, coding: str) -> None:
    bomb = gzip.compress(gzip.compress(b" " * (64 << 20)) if coding == "gzip, gzip" else b" " * (64 << 20))

    def behave(handler: Handler, _: Any) -> None:
        handler.send_response(status)
        handler.send_header("Content-Type", "application/json")
        handler.send_header("Content-Encoding", coding)
        handler.send_header("Content-Length", str(len(bomb)))
        handler.end_headers()
        handler.wfile.write(bomb)

    with serving(behave) as server, pytest.raises(ServerError, match=f"compressed its reply .{coding}."):
        ask(server.url, retries=2)
    assert len(server.requests) == 1
    assert server.requests[0][0]["accept-encoding"] == "identity"


def redirect(location: str, status: int) -> Callable[[Handler, Any], None]:
    def behave(handler: Handler, _: Any) -> None:
        handler.send_response(status)
        handler.send_header("Location", location)
        handler.send_header("Content-Length", "0")
        handler.end_headers()

    return behave


@pytest.mark.parametrize("status", [301, 302, 303, 307, 308])
def test_a_redirect_to_another_server_is_refused_once_and_names_it(status: int) -> None:
    with serving(answer("stolen")) as other, serving(redirect(f"{other.url}/chat/completions", status)) as server:
        with pytest.raises(ServerError, match=f"redirects to {other.url.removesuffix('/v1')} .{status}."):
            ask(server.url, retries=2)
        assert (len(server.requests), len(other.requests)) == (1, 0)


@pytest.mark.parametrize(
    ("location", "named"),
    [
        ("https://127.0.0.1:{port}/v1/chat/completions", "https://127.0.0.1:{port}"),
        ("http://localhost:{port}/v1/chat/completions", "http://localhost:{port}"),
        ("//elsewhere.invalid/v1", "http://elsewhere.invalid"),
        ("http://127.0.0.1/v1", "http://127.0.0.1 "),
        ("http://127.0.0.1:{port}@elsewhere.invalid/", "http://elsewhere.invalid"),
        ("http:\\\\elsewhere.invalid/", ""),
        ("http://[::1", ""),
        ("http:///v1", ""),
        ("ftp://elsewhere.invalid/", "ftp://elsewhere.invalid"),
    ],
)
def test_what_is_not_the_same_scheme_host_and_port_is_another_server(location: str, named: str) -> None:
    with serving(answer("x")) as server:
        port = server.server_address[1]
        server.behave = redirect(location.format(port=port), 307)
        with pytest.raises(ServerError, match=f"redirects to {named.format(port=port)}"):
            ask(server.url, retries=2)
        assert len(server.requests) == 1


@pytest.mark.parametrize("location", ["/v2/chat", "http://127.0.0.1:{port}/v2/chat"])
def test_a_redirect_within_a_server_is_followed(location: str) -> None:
    def behave(handler: Handler, body: Any) -> None:
        if handler.path == "/v2/chat":
            answer("moved")(handler, body)
        else:
            redirect(location.format(port=server.server_address[1]), 307)(handler, body)

    with serving(behave) as server:
        assert ask(server.url, retries=0).text == "moved"


def test_a_redirect_that_leads_away_in_its_second_step_is_refused() -> None:
    def behave(handler: Handler, body: Any) -> None:
        redirect("http://elsewhere.invalid/" if handler.path == "/v2" else "/v2", 307)(handler, body)

    with serving(behave) as server, pytest.raises(ServerError, match="redirects to http://elsewhere.invalid"):
        ask(server.url, retries=2)


def test_a_fault_of_one_reply_is_not_told_of_the_next() -> None:
    with serving(redirect("http://elsewhere.invalid/", 307)) as server:
        config = VlmConfig(base_url=server.url, model="m", retries=0, timeout=5.0)
        client = VlmServer(config)
        with pytest.raises(ServerError, match="redirects"):
            client.ask(request_body([], config))
        server.behave = answer("fine")
        assert client.ask(request_body([], config)).text == "fine"
    with pytest.raises(ServerError, match="no server answers there"):
        client.ask(request_body([], config))


def test_connections_end_with_their_server() -> None:
    with serving(answer("fine")) as server:
        config = VlmConfig(base_url=server.url, model="m", retries=0, timeout=5.0)
        client = VlmServer(config)
        client.ask(request_body([], config))
        http = client._client._client
        assert not http.is_closed
        del client
        gc.collect()
        assert http.is_closed


MEASURED = """
import sys
from gsencoder.infer.ask.server import VlmConfig, VlmServer, request_body
from gsencoder.app.output import peak_memory_mb
config = VlmConfig(base_url=sys.argv[1], model="m", retries=0, stream=sys.argv[2] == "True")
server = VlmServer(config)
before = peak_memory_mb()
try:
    server.ask(request_body([], config))
except ValueError as error:
    assert "sent more than" in str(error), error
    print(peak_memory_mb() - before)
"""


@pytest.mark.parametrize("stream", [True, False])
@pytest.mark.parametrize("status", [200, 400])
@pytest.mark.alone
def test_memory_stays_bounded_whatever_a_server_sends(status: int, stream: bool) -> None:
    with serving(endless(status, "until the end", [])) as server:
        command = [sys.executable, "-c", MEASURED, server.url, str(stream)]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert float(done.stdout) < 300
