"""Settings of a server: keys that are never repeated, the environment, and what is refused."""

import json
import traceback
from typing import Any

import pytest
from chat_server import answer, serving
from server_questions import KEY, ask, config

from gsencoder.app.options import HIDDEN, settings
from gsencoder.core.errors import InputError
from gsencoder.infer.ask.server import (
    KEY_VARIABLE,
    MODEL_VARIABLE,
    URL_VARIABLE,
    ServerError,
    VlmConfig,
    VlmServer,
    request_body,
)

pytest.importorskip("openai")


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
