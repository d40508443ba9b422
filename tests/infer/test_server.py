"""What is asked of a server of a vision-language model, what becomes of each of its faults, and keys that no text of it
shows."""

import gc
import html
import json
import socket
import time
import traceback
from collections.abc import Callable
from typing import Any
from urllib.parse import quote, quote_plus

import numpy as np
import pytest
from chat_server import Handler, answer, events, serving, silent

from gsencoder.app.options import HIDDEN, settings
from gsencoder.core.errors import InputError
from gsencoder.infer.ask.ask import prompt_messages
from gsencoder.infer.ask.server import (
    KEY_VARIABLE,
    MODEL_VARIABLE,
    URL_VARIABLE,
    KeyFilter,
    Reply,
    ServerError,
    VlmConfig,
    VlmServer,
    request_body,
)

pytest.importorskip("openai")

KEY = "sk-a+b/c=\"<&>'\\~x%yz-0123456789"
Behave = Callable[[Handler, Any], None]


@pytest.fixture(autouse=True)
def no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (URL_VARIABLE, KEY_VARIABLE, MODEL_VARIABLE):
        monkeypatch.delenv(name, raising=False)


def config(url: str, **changed: Any) -> VlmConfig:
    return VlmConfig(**{"base_url": url, "model": "tiny", "key": KEY, "retries": 0, "timeout": 5.0} | changed)


def ask(url: str, **changed: Any) -> Reply:
    chosen = config(url, **changed)
    picture = np.zeros((8, 8, 3), np.uint8)
    return VlmServer(chosen).ask(request_body(prompt_messages("what?", [picture], side=64), chosen))


def status(code: int, message: str) -> Behave:
    return lambda handler, _: handler.reply(code, {"error": {"message": message}})


def stream(data: bytes) -> Behave:
    return lambda handler, _: handler.raw(200, data, "text/event-stream")


def chunk(finish: str | None = "stop", model: str = "tiny", usage: Any = None, **delta: Any) -> bytes:
    choice = {"index": 0, "delta": delta, "finish_reason": finish}
    whole = {"id": "1", "object": "chat.completion.chunk", "created": 0, "model": model, "choices": [choice]}
    return f"data: {json.dumps(whole | ({'usage': usage} if usage else {}))}\n\ndata: [DONE]\n\n".encode()


def test_an_answer_comes_back_whole_with_what_the_server_says_of_it() -> None:
    with serving(answer("a red mug")) as server:
        reply = ask(server.url, max_tokens=17, temperature=0.5)
    assert (reply.text, reply.model, reply.finish) == ("a red mug", "tiny", "stop")
    assert reply.tokens == {"prompt": 7, "answer": 2}
    headers, body = server.requests[0]
    assert headers["authorization"] == f"Bearer {KEY}"
    assert (body["model"], body["max_tokens"], body["temperature"], body["stream"]) == ("tiny", 17, 0.5, True)
    assert body["stream_options"] == {"include_usage": True}
    assert [part["type"] for part in body["messages"][0]["content"]] == ["image_url", "text"]


def test_where_no_server_is_the_error_says_so() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{free.getsockname()[1]}/v1"
    with pytest.raises(ServerError, match=f"the server at {url}: no server answers there .*refused.*dry_run=true"):
        ask(url)


@pytest.mark.parametrize(
    ("behave", "problem", "of_server"),
    [
        (status(500, "out of memory"), "failed 1 times .500: out of memory", True),
        (status(400, "too many images"), "refuses the request .400: too many images", False),
        (status(401, "bad key"), "refuses the key .401: bad key.; give vlm.key= or OPENAI_API_KEY", True),
        (status(404, "no model x"), "has no model of that name, .*no model x", True),
        (lambda handler, _: handler.reply(422, {"detail": "pinned"}), "refuses the request .422: pinned", False),
        (lambda handler, _: handler.raw(200, b"", "application/json"), "nothing that is a chat completion", True),
        (silent(3.0), "was silent for 0.5 s .vlm.timeout", True),
        (stream(events("a red ", "mu", finish=None, done=False)), "cut off after 8 characters", True),
        (stream(b"data: {not json}\n\n"), "broke off .*or is no chat completion", True),
        (stream(events("a re", done=False, finish=None) + b'data: {"error": {"message": "GPU"}}\n\n'), "GPU", True),
        (stream(events(finish="stop")), "the answer holds no text .it ended with 'stop'", False),
        (stream(chunk("content_filter", content="The cu")), "a filter cut the answer off after 6 characters", False),
        (stream(chunk(refusal="I must not look")), "the model refuses: I must not look", False),
        (stream(chunk("length", content=None)), "holds no text .*raise vlm.max_tokens", False),
    ],
)
def test_each_fault_is_an_error_in_one_line_of_the_server_or_of_the_question(behave, problem, of_server):
    with serving(behave) as server, pytest.raises(InputError, match=problem) as caught:
        ask(server.url, timeout=0.5)
    assert isinstance(caught.value, ServerError) == of_server
    assert "\n" not in str(caught.value)


def test_a_connection_that_breaks_within_a_stream_is_an_error() -> None:
    def behave(handler: Handler, _: Any) -> None:
        data = events("a red ", finish=None, done=False)
        handler.raw(200, data, "text/event-stream", length=len(data) + 1000)
        handler.connection.shutdown(socket.SHUT_RDWR)

    with serving(behave) as server, pytest.raises(ServerError, match="broke off after 6 characters"):
        ask(server.url)


def test_an_answer_that_drips_for_ever_ends() -> None:
    def behave(handler: Handler, _: Any) -> None:
        handler.send_response(200)
        handler.send_header("Content-Type", "text/event-stream")
        handler.end_headers()
        for _ in range(40):
            handler.wfile.write(b": ping\n\n")
            handler.wfile.flush()
            time.sleep(0.1)

    begun = time.monotonic()
    with serving(behave) as server, pytest.raises(ServerError, match="took more than 0.5 s .vlm.longest"):
        ask(server.url, longest=0.5, timeout=0.4)
    assert time.monotonic() - begun < 3


@pytest.mark.slow
def test_a_server_that_fails_at_first_is_asked_again() -> None:
    calls: list[int] = []

    def behave(handler: Handler, body: Any) -> None:
        calls.append(1)
        (status(500, "busy") if len(calls) < 3 else answer("fine"))(handler, body)

    with serving(behave) as server:
        assert ask(server.url, retries=2).text == "fine"
    assert len(calls) == 3


def test_a_redirect_is_not_followed_and_named() -> None:
    def redirect(handler: Handler, _: Any) -> None:
        handler.send_response(307)
        handler.send_header("Location", f"{other.url}/chat/completions")
        handler.send_header("Content-Length", "0")
        handler.end_headers()

    with serving(answer("stolen")) as other, serving(redirect) as server:
        with pytest.raises(ServerError, match=f"redirects to {other.url}/chat/completions .307."):
            ask(server.url, retries=2)
        assert (len(server.requests), len(other.requests)) == (1, 0)


def test_connections_end_with_their_server() -> None:
    with serving(answer("fine")) as server:
        client = VlmServer(config(server.url))
        client.ask(request_body([], config(server.url)))
        http = client._client._client
        assert not http.is_closed
        del client
        gc.collect()
        assert http.is_closed


def test_a_server_names_its_limit_and_its_temperature_as_it_likes() -> None:
    body = request_body([], config("http://x/v1", limit_by="max_completion_tokens", temperature=None, max_tokens=9))
    assert body["max_completion_tokens"] == 9
    assert not {"max_tokens", "temperature"} & set(body)


def test_what_is_left_out_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=f"say where the model's server is .*{URL_VARIABLE}"):
        VlmServer(VlmConfig())
    with pytest.raises(InputError, match=MODEL_VARIABLE):
        request_body([], VlmConfig())
    assert request_body([], VlmConfig(), named=False)["model"] == ""
    with serving(answer("fine")) as server:
        monkeypatch.setenv(URL_VARIABLE, server.url)
        monkeypatch.setenv(KEY_VARIABLE, KEY)
        monkeypatch.setenv(MODEL_VARIABLE, "theirs")
        VlmServer(VlmConfig()).ask(request_body([], VlmConfig()))
        headers, body = server.requests[0]
    assert headers["authorization"] == f"Bearer {KEY}"
    assert body["model"] == "theirs"


def test_settings_of_a_server_that_make_no_sense_are_refused() -> None:
    urls = ("localhost:8000", "http://[::1", "http://x /v1")
    for wrong in ({"longest": float("nan")}, *({"base_url": url} for url in urls)):
        with pytest.raises(InputError, match="expected"):
            VlmConfig(**wrong)


@pytest.mark.parametrize(
    "url", ["http://bob:hunter2pw@x/v1", "http://x/v1?api_key=hunter2pw", "http://hunter2pw@x:y/v1"]
)
def test_addresses_that_hold_a_secret_are_refused_without_telling_it(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="keys belong in vlm.key") as caught:
        VlmConfig(base_url=url)
    assert "hunter2pw" not in str(caught.value)
    monkeypatch.setenv(URL_VARIABLE, url)
    with pytest.raises(InputError, match=URL_VARIABLE) as caught:
        VlmServer(VlmConfig())
    assert "hunter2pw" not in str(caught.value)


SPELLINGS = {
    "plain": KEY,
    "URL": quote(KEY, safe=""),
    "URL with slashes": quote(KEY),
    "form": quote_plus(KEY),
    "URL in lower case": quote(KEY, safe="").replace("%2B", "%2b"),
    "twice URL": quote(quote(KEY, safe=""), safe=""),
    "HTML": html.escape(KEY),
    "HTML twice": html.escape(html.escape(KEY)),
    "HTML by number": "".join(f"&#{ord(letter)};" for letter in KEY),
    "HTML by hexadecimal number": "".join(f"&#x{ord(letter):X};" for letter in KEY),
    "JSON": json.dumps(KEY)[1:-1],
    "JSON twice": json.dumps(json.dumps(KEY))[3:-3],
    "JSON with slashes": json.dumps(KEY)[1:-1].replace("/", "\\/"),
    "JSON by number": "".join(f"\\u{ord(letter):04x}" for letter in KEY),
    "Python": repr(KEY)[1:-1],
    "cut off": KEY[:16],
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_a_key_is_recognised_however_it_is_spelt(spelling: str) -> None:
    text = KeyFilter(KEY).clean(f"the header is Bearer {SPELLINGS[spelling]}, not valid")
    assert text == "the header is Bearer (key), not valid"


def test_text_without_the_key_stays_as_it_is_and_is_cut_after_the_key_is_gone() -> None:
    filtered = KeyFilter(KEY)
    for text in ("", "sk-", "sk-a+b", "a red mug", "\\" * 20, "&amp;" * 20, "%25" * 20):
        assert filtered.clean(text) == text
        assert not filtered.is_in(text)
    # Placeholders are words of any language.
    assert KeyFilter("none").clean("there is none") == "there is none"
    assert KeyFilter("").clean("anything") == "anything"
    assert filtered.clean("x" * 7 + KEY, longest=12) == "xxxxxxx(key)"


def test_long_text_of_escapes_and_long_keys_take_no_longer_than_others() -> None:
    begun = time.monotonic()
    for text in ("\\" * 500_000, "%25" * 200_000, "&amp;" * 100_000, "&#000000" * 60_000):
        assert KeyFilter(KEY).clean(text) == text
    for long in (KEY * 3300, KEY * 20):
        text = f"a {quote(long, safe='')} b {long} c {long[:600]} d"
        assert KeyFilter(long).clean(text) == "a (key) b (key) c (key) d"
        assert KeyFilter(long).clean("no key") == "no key"
    strange = KEY * 10 + "\\\\%25" * 3000
    assert KeyFilter(strange).clean(f"a {strange} b") == "a (key) b"
    assert time.monotonic() - begun < 10


def test_every_field_of_an_answer_is_without_the_key_and_no_longer_than_names_are() -> None:
    with serving(stream(chunk(KEY, model=KEY, content=f"a {KEY} b"))) as server:
        reply = ask(server.url)
        assert (reply.text, reply.model, reply.finish) == ("a (key) b", "(key)", "(key)")
        server.behave = stream(chunk("f" * 5000, model="m" * 5000, content="a"))
        reply = ask(server.url)
        assert max(len(reply.model), len(reply.finish)) <= 200
        # A key that is split over pieces.
        server.behave = stream(events(f"a {KEY[:9]}", KEY[9:], " b"))
        assert ask(server.url).text == "a (key) b"


@pytest.mark.parametrize("count", [1234567, -1, 10**300])
def test_a_key_of_digits_and_what_is_no_count_are_not_written_as_counts_of_tokens(count: int) -> None:
    usage = {"prompt_tokens": count, "completion_tokens": 3, "total_tokens": 5}
    with serving(stream(chunk(content="a", usage=usage))) as server:
        assert ask(server.url, key="1234567").tokens == {"answer": 3}


@pytest.mark.parametrize("within_stream", [True, False])
def test_no_error_repeats_the_key(within_stream: bool) -> None:
    text = ""

    def behave(handler: Handler, _: Any) -> None:
        if within_stream:
            handler.raw(200, f"data: {json.dumps({'detail': text})}\n\n".encode(), "text/event-stream")
        else:
            handler.reply(400, {"error": {"message": text}})

    with serving(behave) as server:
        client = VlmServer(config(server.url))
        for before in (0, 280):
            for name, spelling in SPELLINGS.items():
                text = "x" * before + spelling
                with pytest.raises(InputError) as caught:
                    client.ask(request_body([], config(server.url)))
                assert spelling[:8] not in "".join(traceback.format_exception(caught.value)), name


def test_a_key_is_in_no_setting_and_one_from_a_file_may_end_with_a_line_break() -> None:
    with serving(answer(f"your header is Bearer {KEY}")) as server:
        assert ask(server.url, key=f"{KEY}\n").text == "your header is Bearer (key)"
        assert server.requests[-1][0]["authorization"] == f"Bearer {KEY}"
    for wrong in ("sk-\N{BULLET}123456", "sk-12\n3456"):
        with pytest.raises(InputError, match="holds characters that no key has") as caught:
            VlmServer(config("http://x/v1", key=wrong))
        assert wrong not in str(caught.value)
    chosen = config("http://x/v1")
    assert settings(chosen)["key"] == HIDDEN
    assert settings(VlmConfig())["key"] == ""
    assert KEY not in json.dumps(settings(chosen))
    assert KEY not in json.dumps(request_body([], chosen))
