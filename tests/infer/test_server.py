"""What is asked of a server of a vision-language model, and what becomes of each of its faults."""

import json
import socket
import time
import traceback
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from chat_server import Handler, answer, completion, events, serving, silent

from gsencoder.app.settings.config import HIDDEN, settings
from gsencoder.core.errors import InputError
from gsencoder.infer.ask.prompts import messages
from gsencoder.infer.ask.reply import ServerError
from gsencoder.infer.ask.server import KEY_VARIABLE, MODEL_VARIABLE, URL_VARIABLE, VlmConfig, VlmServer, request_body

pytest.importorskip("openai")


KEY = "sk-1234567890"
BOTH = pytest.mark.parametrize("stream", [True, False])


def config(url: str, **changed: Any) -> VlmConfig:
    return VlmConfig(**{"base_url": url, "model": "tiny", "key": KEY, "retries": 0, "timeout": 5.0} | changed)


def ask(url: str, **changed: Any) -> Any:
    chosen = config(url, **changed)
    picture = np.zeros((8, 8, 3), np.uint8)
    return VlmServer(chosen).ask(request_body(messages("what?", [picture], side=64, kind="png"), chosen))


@BOTH
def test_an_answer_comes_back_whole_with_what_the_server_says_of_it(stream: bool) -> None:
    with serving(answer("a red mug")) as server:
        reply = ask(server.url, stream=stream, max_tokens=17, temperature=0.5)
    assert reply.text == "a red mug"
    assert (reply.model, reply.finish) == ("tiny", "stop")
    assert reply.tokens == {"prompt": 7, "answer": 2}
    headers, body = server.requests[0]
    assert headers["authorization"] == f"Bearer {KEY}"
    assert (body["model"], body["max_tokens"], body["temperature"], body["stream"]) == ("tiny", 17, 0.5, stream)
    assert body.get("stream_options") == ({"include_usage": True} if stream else None)
    kinds = [part["type"] for part in body["messages"][0]["content"]]
    assert kinds == ["image_url", "text"]


def refused() -> str:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{free.getsockname()[1]}/v1"


@BOTH
def test_where_no_server_is_the_error_says_so(stream: bool) -> None:
    url = refused()
    with pytest.raises(InputError, match=f"the server at {url}: no server answers there .*refused.*dry_run=true"):
        ask(url, stream=stream)


def status(code: int, message: str) -> Callable[[Handler, Any], None]:
    return lambda handler, _: handler.reply(code, {"error": {"message": message}})


@BOTH
@pytest.mark.parametrize(
    ("behave", "told"),
    [
        (status(500, "out of memory"), "failed 1 times .500: out of memory"),
        (status(503, "loading"), "failed 1 times .503: loading"),
        (status(429, "slow down"), "failed 1 times .429: slow down"),
        (status(400, "too many images"), "refuses the request .400: too many images"),
        (status(401, "bad key"), "refuses the key .401: bad key.; give vlm.key= or OPENAI_API_KEY"),
        (status(404, "no model x"), "has no model of that name, .*no model x.; it has tiny"),
        (lambda handler, _: handler.reply(422, {"detail": "pinned"}), "refuses the request .422: pinned"),
        (
            lambda handler, _: handler.raw(200, b"", "application/json"),
            "sent nothing that is a chat|is no chat completion",
        ),
        (silent(3.0), "was silent for 0.5 s .vlm.timeout"),
    ],
)
def test_each_fault_of_a_server_is_an_error_in_its_own_words(
    behave: Callable[[Handler, Any], None], told: str, stream: bool
) -> None:
    with serving(behave) as server, pytest.raises(InputError, match=told):
        ask(server.url, stream=stream, timeout=0.5)


@pytest.mark.parametrize(
    "value",
    [
        {"choices": []},
        {"hello": 1},
        [],
        completion(None),
        completion("  "),
        completion("half", finish=None),
    ],
)
def test_answers_that_are_none_are_errors(value: Any) -> None:
    with serving(lambda handler, _: handler.reply(200, value)) as server, pytest.raises(InputError, match="answer"):
        ask(server.url, stream=False)


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (events("a red ", "mu", finish=None, done=False), "cut off after 8 characters"),
        (events("a red ", "mu", finish=None), "cut off after 8 characters"),
        (events(finish="stop"), "the answer holds no text .it ended with 'stop'"),
        (b"data: {not json}\n\n", "broke off, or is no chat completion"),
        (b"<html>hello</html>", "sent nothing that is a chat"),
        (events("fine") + b'data: {"error": {"message": "GPU fell over"}}\n\n', "GPU fell over|^$"),
    ],
)
def test_streams_that_end_early_are_errors(data: bytes, told: str) -> None:
    def behave(handler: Handler, _: Any) -> None:
        handler.raw(200, data, "text/event-stream")

    with serving(behave) as server:
        if data.endswith(b'over"}}\n\n'):
            # What follows the end is not waited for.
            assert ask(server.url).text == "fine"
        else:
            with pytest.raises(InputError, match=told):
                ask(server.url)


def test_a_connection_that_breaks_within_a_stream_is_an_error() -> None:
    def behave(handler: Handler, _: Any) -> None:
        data = events("a red ", finish=None, done=False)
        handler.raw(200, data, "text/event-stream", length=len(data) + 1000)
        handler.connection.shutdown(socket.SHUT_RDWR)

    with serving(behave) as server, pytest.raises(InputError, match="broke off after 6 characters"):
        ask(server.url)


def test_an_answer_that_drips_for_ever_ends() -> None:
    def behave(handler: Handler, _: Any) -> None:
        handler.send_response(200)
        handler.send_header("Content-Type", "text/event-stream")
        handler.end_headers()
        for _ in range(100):
            handler.wfile.write(events("a", finish=None, done=False))
            handler.wfile.flush()
            time.sleep(0.05)

    with serving(behave) as server, pytest.raises(ServerError, match="took more than 0.3 s .vlm.longest"):
        ask(server.url, longest=0.3)


@BOTH
def test_a_connection_that_is_only_kept_alive_ends_with_the_patience(stream: bool) -> None:
    def behave(handler: Handler, _: Any) -> None:
        handler.send_response(200)
        handler.send_header("Content-Type", "text/event-stream" if stream else "application/json")
        handler.end_headers()
        for _ in range(40):
            handler.wfile.write(b": ping\n\n" if stream else b" ")
            handler.wfile.flush()
            time.sleep(0.1)

    begun = time.monotonic()
    with serving(behave) as server, pytest.raises(ServerError, match="took more than 0.5 s .vlm.longest"):
        ask(server.url, stream=stream, longest=0.5, timeout=0.4)
    assert time.monotonic() - begun < 3


def test_patience_holds_for_all_tries_together() -> None:
    def behave(handler: Handler, _: Any) -> None:
        handler.send_response(503)
        handler.send_header("Retry-After", "20")
        handler.send_header("Content-Length", "0")
        handler.end_headers()

    with serving(behave) as server, pytest.raises(ServerError, match="took more than 0.5 s"):
        ask(server.url, longest=0.5, retries=3)


def finished(finish: str, **message: Any) -> dict[str, Any]:
    whole = completion("The cu", finish)
    whole["choices"][0]["message"] |= message
    return whole


@pytest.mark.parametrize(
    ("whole", "told"),
    [
        (finished("content_filter"), "a filter cut the answer off after 6 characters"),
        (finished("stop", content=None, refusal="I must not look"), "the model refuses: I must not look"),
        (
            finished("length", content="", reasoning_content="hmm"),
            "no text .*it thought until vlm.max_tokens; raise it",
        ),
        (finished("length", content=None), "no text .*it went on until vlm.max_tokens; raise it"),
        (finished("tool_calls", content=None), "no text .*it calls a tool, and none is offered"),
    ],
)
def test_answers_that_a_model_keeps_back_are_about_the_question_and_not_the_server(whole: Any, told: str) -> None:
    with (
        serving(lambda handler, _: handler.reply(200, whole)) as server,
        pytest.raises(InputError, match=told) as error,
    ):
        ask(server.url, stream=False)
    assert not isinstance(error.value, ServerError)


@pytest.mark.parametrize("text", ["a red mug", None])
def test_a_server_that_streams_nothing_is_to_be_asked_without_a_stream(text: str | None) -> None:
    with (
        serving(lambda handler, _: handler.reply(200, completion(text))) as server,
        pytest.raises(ServerError, match="JSON in place of the stream that was asked for; give vlm.stream=false, or"),
    ):
        ask(server.url)


def test_odd_but_whole_answers_are_taken() -> None:
    odd = finished("stop", content=[{"type": "text", "text": "a red "}, {"type": "text", "text": "mug"}])
    odd["usage"] = {"prompt_tokens": "many"}
    with serving(lambda handler, _: handler.reply(200, odd)) as server:
        reply = ask(server.url, stream=False)
    assert (reply.text, reply.tokens) == ("a red mug", {})


def test_an_error_within_a_stream_is_told_in_the_servers_words() -> None:
    data = events("a re", finish=None, done=False) + b'event: error\ndata: {"message": "GPU fell"}\n\n'
    with (
        serving(lambda handler, _: handler.raw(200, data, "text/event-stream")) as server,
        pytest.raises(ServerError, match="after 4 characters.*GPU fell"),
    ):
        ask(server.url)


def test_a_server_names_its_limit_and_its_temperature_as_it_likes() -> None:
    body = request_body([], config("http://x/v1", limit_by="max_completion_tokens", temperature=None, max_tokens=9))
    assert body["max_completion_tokens"] == 9
    assert not {"max_tokens", "temperature"} & set(body)


@pytest.mark.slow
def test_a_server_that_fails_at_first_is_asked_again() -> None:
    calls: list[int] = []

    def behave(handler: Handler, body: Any) -> None:
        calls.append(1)
        (status(500, "busy") if len(calls) < 3 else answer("fine"))(handler, body)

    with serving(behave) as server:
        assert ask(server.url, retries=2).text == "fine"
    assert len(calls) == 3


@pytest.mark.slow
def test_keys_are_never_told() -> None:
    echo = serving(lambda handler, _: handler.reply(400, {"error": {"message": f"bad key {KEY}"}}))
    with echo as server, pytest.raises(InputError) as caught:
        ask(server.url)
    assert KEY not in str(caught.value)
    assert "bad key (key)" in str(caught.value)
    # Neither where the message is cut, nor in the traceback of --debug, nor in an answer.
    long = serving(lambda handler, _: handler.reply(400, {"error": {"message": "x" * 295 + KEY}}))
    with long as server, pytest.raises(InputError) as caught:
        ask(server.url)
    assert KEY[:5] not in str(caught.value)
    assert KEY not in "".join(traceback.format_exception(caught.value))
    with serving(answer(f"your header is Bearer {KEY}")) as server:
        assert ask(server.url).text == "your header is Bearer (key)"
        # A key from a file ends with a line break.
        ask(server.url, key=f"{KEY}\n")
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
        chosen = VlmConfig()
        VlmServer(chosen).ask(request_body([], chosen))
        headers, body = server.requests[0]
    assert headers["authorization"] == f"Bearer {KEY}"
    assert body["model"] == "theirs"


@pytest.mark.parametrize(
    "wrong",
    [
        {"timeout": 0.0},
        {"longest": float("nan")},
        {"retries": -1},
        {"max_tokens": 0},
        {"temperature": 3.0},
        {"image_side": 1},
        {"base_url": "localhost:8000"},
        {"base_url": "ftp://x/v1"},
        {"base_url": "http:///v1"},
        {"base_url": "http://x:abc/v1"},
        {"base_url": "http://[::1"},
        {"base_url": "http://x /v1"},
        {"base_url": "http://x\x07/v1"},
    ],
)
def test_settings_of_a_server_that_make_no_sense_are_refused(wrong: dict[str, Any]) -> None:
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


def test_settings_of_proxies_and_certificates_that_cannot_be_used_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("http_proxy", "HTTP_PROXY", "no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    with monkeypatch.context() as within:
        within.setenv("HTTP_PROXY", "foo://x")
        with pytest.raises(InputError, match="no connection can be set up .*HTTP_PROXY leads? through a proxy"):
            VlmServer(config("http://127.0.0.1:9/v1"))
    with monkeypatch.context() as within:
        within.setenv("http_proxy", "http://127.0.0.1:9")
        with pytest.raises(ServerError, match="no server answers there .*http_proxy leads? through a proxy"):
            ask("http://127.0.0.1:10/v1")
