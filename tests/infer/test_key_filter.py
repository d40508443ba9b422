"""A key that a server repeats is taken out of all that it sends."""

import html
import json
import time
import traceback
from typing import Any
from urllib.parse import quote, quote_plus

import pytest
from chat_server import Handler, completion, events, serving

from gsencoder.core.errors import InputError
from gsencoder.infer.ask.server import (
    KEY_VARIABLE,
    MODEL_VARIABLE,
    URL_VARIABLE,
    KeyFilter,
    Reply,
    VlmConfig,
    VlmServer,
    request_body,
)

pytest.importorskip("openai")

KEY = "sk-a+b/c=\"<&>'\\~x%yz-0123456789"
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


@pytest.fixture(autouse=True)
def no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (URL_VARIABLE, KEY_VARIABLE, MODEL_VARIABLE):
        monkeypatch.delenv(name, raising=False)


def ask(url: str, **changed: Any) -> Reply:
    config = VlmConfig(**{"base_url": url, "model": "m", "key": KEY, "retries": 0, "timeout": 5.0} | changed)
    return VlmServer(config).ask(request_body([], config))


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_a_key_is_recognised_however_it_is_spelt(spelling: str) -> None:
    text = KeyFilter(KEY).clean(f"the header is Bearer {SPELLINGS[spelling]}, not valid")
    assert text == "the header is Bearer (key), not valid"


def test_text_without_the_key_stays_as_it_is() -> None:
    filtered = KeyFilter(KEY)
    for text in ("", "sk-", "sk-a+b", "a red mug", "\\" * 20, "&amp;" * 20, "%25" * 20):
        assert filtered.clean(text) == text
        assert not filtered.is_in(text)
    # Placeholders are words of any language.
    assert KeyFilter("none").clean("there is none") == "there is none"
    assert KeyFilter("").clean("anything") == "anything"


def test_a_key_is_taken_out_before_text_is_cut() -> None:
    assert KeyFilter(KEY).clean("x" * 7 + KEY, longest=12) == "xxxxxxx(key)"


def test_long_text_of_escapes_takes_no_longer_than_other_text() -> None:
    begun = time.monotonic()
    for text in ("\\" * 2_000_000, "%25" * 700_000, "&amp;" * 400_000, "&#000000" * 250_000):
        assert KeyFilter(KEY).clean(text) == text
    assert time.monotonic() - begun < 10


def test_a_long_key_is_recognised_as_fast_and_whole() -> None:
    begun = time.monotonic()
    for long in (KEY * 3300, KEY * 20):
        text = f"a {quote(long, safe='')} b {long} c {long[:600]} d"
        assert KeyFilter(long).clean(text) == "a (key) b (key) c (key) d"
        assert KeyFilter(long).clean("no key") == "no key"
    strange = KEY * 10 + "\\\\%25" * 3000
    assert KeyFilter(strange).clean(f"a {strange} b") == "a (key) b"
    assert time.monotonic() - begun < 5


def test_every_field_of_an_answer_is_without_the_key() -> None:
    whole = completion(f"a {KEY} b", KEY)
    whole["model"] = KEY
    with serving(lambda handler, _: handler.reply(200, whole)) as server:
        reply = ask(server.url, stream=False)
    assert (reply.text, reply.model, reply.finish) == ("a (key) b", "(key)", "(key)")


def test_a_key_that_is_split_over_pieces_is_recognized() -> None:
    data = events(f"a {KEY[:9]}", KEY[9:], " b")
    with serving(lambda handler, _: handler.raw(200, data, "text/event-stream")) as server:
        assert ask(server.url).text == "a (key) b"


def test_a_key_of_digits_is_not_written_as_a_count_of_tokens() -> None:
    whole = completion("a")
    whole["usage"] = {"prompt_tokens": 1234567, "completion_tokens": 3, "total_tokens": 5}
    with serving(lambda handler, _: handler.reply(200, whole)) as server:
        reply = ask(server.url, stream=False, key="1234567")
    assert reply.tokens == {"answer": 3}


@pytest.mark.parametrize("count", [-1, 10**300])
def test_counts_of_tokens_that_are_none_are_left_out(count: Any) -> None:
    whole = completion("a")
    whole["usage"] = {"prompt_tokens": count, "completion_tokens": 3, "total_tokens": 5}
    with serving(lambda handler, _: handler.reply(200, whole)) as server:
        assert ask(server.url, stream=False).tokens == {"answer": 3}


def test_names_of_a_server_are_written_down_no_longer_than_names_are() -> None:
    whole = completion("a", "f" * 5000) | {"model": "m" * 5000}
    with serving(lambda handler, _: handler.reply(200, whole)) as server:
        reply = ask(server.url, stream=False)
    assert max(len(reply.model), len(reply.finish)) <= 200


@pytest.mark.parametrize("stream", [True, False])
def test_no_error_repeats_the_key(stream: bool) -> None:
    text = ""

    def behave(handler: Handler, body: Any) -> None:
        if body["stream"]:
            handler.raw(200, f"data: {json.dumps({'detail': text})}\n\n".encode(), "text/event-stream")
        else:
            handler.reply(400, {"error": {"message": text}})

    with serving(behave) as server:
        config = VlmConfig(base_url=server.url, model="m", key=KEY, retries=0, stream=stream)
        client = VlmServer(config)
        for before in (0, 280, 1990):
            for name, spelling in SPELLINGS.items():
                text = "x" * before + spelling
                with pytest.raises(InputError) as caught:
                    client.ask(request_body([], config))
                assert spelling[:8] not in "".join(traceback.format_exception(caught.value)), name


@pytest.mark.parametrize("models", [[{"id": KEY}], [{"id": None}], [{}], [5], None])
def test_a_list_of_models_is_only_a_hint_and_never_shows_the_key(models: Any) -> None:
    with serving(lambda handler, _: handler.reply(404, {"error": {"message": "no"}})) as server:
        server.listing = lambda handler: handler.reply(200, {"object": "list", "data": models})
        with pytest.raises(InputError, match="has no model of that name") as caught:
            ask(server.url)
    assert KEY[:8] not in str(caught.value)
