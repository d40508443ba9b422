"""What is asked of a server of a vision-language model, and what becomes of each of its faults."""

import socket
import time
from collections.abc import Callable
from typing import Any

import pytest
from chat_server import Handler, answer, completion, events, serving, silent
from server_questions import KEY, ask, config

from gsencoder.core.errors import InputError
from gsencoder.infer.ask.server import ServerError, request_body

pytest.importorskip("openai")

BOTH = pytest.mark.parametrize("stream", [True, False])


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
    ("behave", "problem"),
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
    behave: Callable[[Handler, Any], None], problem: str, stream: bool
) -> None:
    with serving(behave) as server, pytest.raises(InputError, match=problem):
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
    ("data", "problem"),
    [
        (events("a red ", "mu", finish=None, done=False), "cut off after 8 characters"),
        (events("a red ", "mu", finish=None), "cut off after 8 characters"),
        (events(finish="stop"), "the answer holds no text .it ended with 'stop'"),
        (b"data: {not json}\n\n", "broke off, or is no chat completion"),
        (b"<html>hello</html>", "sent nothing that is a chat"),
        (events("fine") + b'data: {"error": {"message": "GPU fell over"}}\n\n', "GPU fell over|^$"),
    ],
)
def test_streams_that_end_early_are_errors(data: bytes, problem: str) -> None:
    def behave(handler: Handler, _: Any) -> None:
        handler.raw(200, data, "text/event-stream")

    with serving(behave) as server:
        if data.endswith(b'over"}}\n\n'):
            # What follows the end is not waited for.
            assert ask(server.url).text == "fine"
        else:
            with pytest.raises(InputError, match=problem):
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
    ("whole", "problem"),
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
def test_answers_that_a_model_keeps_back_are_about_the_question_and_not_the_server(whole: Any, problem: str) -> None:
    with (
        serving(lambda handler, _: handler.reply(200, whole)) as server,
        pytest.raises(InputError, match=problem) as error,
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
