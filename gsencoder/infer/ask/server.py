"""A vision-language model behind a server that speaks OpenAI's chat protocol: vLLM, transformers serve, llama.cpp's
server, a cloud. The key is never written: what a server sends passes `KeyFilter` before anybody sees it."""

import os
import re
import threading
import time
import traceback
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html.entities import html5
from typing import Any, Literal
from urllib.parse import urlsplit

from gsencoder.core.errors import InputError
from gsencoder.core.settings import check_limits, option

LEAST_KEY = 6
"""Shorter keys are placeholders, which servers at home are given; any text may hold their letters."""
LEAST_PART = 12
"""Shorter beginnings of a key are no secret, and mostly its maker's name."""
LONGEST_PART = 256
"""Longer keys, which are compiled for minutes, are recognized by their beginning; what follows is compared letter by
letter."""
REDACTED = "(key)"


class KeyFilter:
    """Removes a key from text, in every spelling that a server gives it when it repeats a request: as it is, quoted for
    a URL, escaped for HTML, JSON or Python, several of these at once, or cut off in its second half."""

    def __init__(self, key: str) -> None:
        self._pattern: re.Pattern[str] | None = None
        self._key, self._rest = key, key[LONGEST_PART:]
        if len(key) >= LEAST_KEY:
            spelt = [_spellings(letter) for letter in key[:LONGEST_PART]]
            least = max(LEAST_PART, (len(spelt) + 1) // 2)
            self._pattern = re.compile("".join(spelt[:least]) + "".join(f"{each}?" for each in spelt[least:]))

    def clean(self, text: str, longest: int | None = None) -> str:
        """Text without the key, and only then cut to `longest` characters."""
        parts, at = [], 0
        # Of a long key with letters that begin escapes, the letters cannot always be distinguished.
        text = text.replace(self._key, REDACTED) if self._pattern else text
        while self._pattern and (match := self._pattern.search(text, at)):
            parts += [text[at : match.start()], REDACTED]
            at = match.end()
            for letter in self._rest:
                if not (match := _pattern_of(letter).match(text, at)):
                    break
                at = match.end()
        return "".join([*parts, text[at:]])[:longest]

    def is_in(self, text: str) -> bool:
        """Whether text holds the key."""
        return self._pattern is not None and self._pattern.search(text) is not None


@cache
def _pattern_of(letter: str) -> re.Pattern[str]:
    return re.compile(_spellings(letter))


@cache
def _spellings(letter: str) -> str:
    """A pattern of one character, escaped never, once, or several times; no part of it repeats without end, as time
    would grow with the square of the text."""
    code = ord(letter)
    names = sorted(name for name, value in html5.items() if value == letter and name.endswith(";"))
    entities = "|".join([f"#0{{0,6}}{code};", f"#[xX]0{{0,6}}(?i:{code:x});", *names])
    # The letter itself comes last, as it may begin its own escape.
    return (
        rf"(?:%(?:25){{0,4}}(?i:{code:02x})|&(?:amp;){{0,4}}(?:{entities})|\\{{1,8}}(?:u00|x)(?i:{code:02x})"
        rf"|\\{{0,8}}{re.escape(letter)}{'|[+]' if letter == ' ' else ''})"
    )


class ServerError(InputError):
    """A fault of the server that another question would meet as well; any other `InputError` is about the question."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """What a model said, in how many seconds, and why it ended ("stop", "length", …); tokens are those that the server
    counts, of prompt and answer."""

    text: str
    model: str
    finish: str
    tokens: dict[str, int]
    seconds: float


@dataclass(slots=True)
class _Heard:
    """An answer as far as it has come."""

    text: str = ""
    model: str = ""
    finish: str = ""
    tokens: dict[str, int] | None = None
    refusal: str = ""
    parts: int = 0

    def hear(self, chunk: Any) -> None:
        if getattr(chunk, "choices", None) is None:
            raise ValueError(str(getattr(chunk, "model_extra", None) or chunk))
        self.parts += 1
        self.model = str(getattr(chunk, "model", "") or self.model)
        self.tokens = _tokens(getattr(chunk, "usage", None)) or self.tokens
        # The last chunk of some servers counts tokens and has no choice.
        for choice in chunk.choices[:1]:
            for name, attribute in (("text", "content"), ("refusal", "refusal")):
                part = getattr(choice.delta, attribute, None)
                setattr(self, name, getattr(self, name) + (part if isinstance(part, str) else ""))
            self.finish = str(choice.finish_reason or self.finish)

    def problem(self) -> str:
        """Why an answer that has ended is none; empty if it is one."""
        if self.refusal:
            return f"the model refuses: {self.refusal}"
        if self.finish == "content_filter":
            return f"a filter cut the answer off after {len(self.text)} characters"
        if self.text.strip():
            return ""
        hint = "; raise vlm.max_tokens" if self.finish == "length" else ""
        return f"the answer holds no text (it ended with {self.finish!r}){hint}"


def _tokens(usage: Any) -> dict[str, int]:
    counts = {"prompt": getattr(usage, "prompt_tokens", None), "answer": getattr(usage, "completion_tokens", None)}
    return {name: count for name, count in counts.items() if isinstance(count, int) and 0 <= count < 2**53}


def _cause(error: BaseException) -> str:
    """The server's message, or that of the first error."""
    body = getattr(error, "body", None)
    for name in ("error", "message", "detail"):
        body = body.get(name, body) if isinstance(body, dict) else body
    if body:
        return " ".join(str(body).split())
    while error.__cause__ is not None or error.__context__ is not None:
        error = error.__cause__ or error.__context__  # type: ignore[assignment]
    return " ".join(str(error).split()) or type(error).__name__


URL_VARIABLE, KEY_VARIABLE, MODEL_VARIABLE = "OPENAI_BASE_URL", "OPENAI_API_KEY", "GSENCODER_VLM_MODEL"
MAX_MESSAGE = 300
"""Characters of a server's message that an error repeats."""
MAX_NAME = 200
"""Characters of a server's name for its model, or for why an answer ended, that are written down."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VlmConfig:
    """Where the model is and how it is asked."""

    base_url: str = option("", f"of the server, such as http://localhost:8000/v1; empty = {URL_VARIABLE}")
    key: str = option("", f"the server's key; empty = {KEY_VARIABLE}; it is never written anywhere", secret=True)
    model: str = option("", f"the model's name on the server; empty = {MODEL_VARIABLE}")
    timeout: float = option(60.0, "seconds that the server may be silent", gt=0, lt=float("inf"))
    longest: float = option(600.0, "seconds that an answer may take in all, retries included", gt=0, lt=float("inf"))
    retries: int = option(2, "times that a busy or failing server is asked again", ge=0, le=100)
    max_tokens: int = option(512, "tokens of the answer", ge=1)
    limit_by: Literal["max_tokens", "max_completion_tokens"] = option(
        "max_tokens", "the name that the server has for max_tokens"
    )
    temperature: float | None = option(
        0.0, "0 = the likeliest answer; empty = the server's, where it takes no other", ge=0, le=2
    )
    image_side: int = option(768, "longer side of the pictures that are sent, pixels", ge=16, le=8192)

    def __post_init__(self) -> None:
        check_limits(self)
        if self.base_url:
            check_url(self.base_url, "base_url")


def request_body(messages: Sequence[Mapping[str, Any]], config: VlmConfig, *, named: bool = True) -> dict[str, Any]:
    """What is sent, but for the key; a dry run needs no model's name (`named`)."""
    model = config.model or os.environ.get(MODEL_VARIABLE, "")
    if named and not model:
        raise InputError(f"vlm.model: name the model that the server has, here or in {MODEL_VARIABLE}")
    body: dict[str, Any] = {"model": model, "messages": list(messages), config.limit_by: config.max_tokens}
    if config.temperature is not None:
        body["temperature"] = config.temperature
    # Without stream_options some servers count no tokens.
    return body | {"stream": True, "stream_options": {"include_usage": True}}


def check_url(url: str, name: str) -> None:
    """Complains about what is no server's address, or holds what belongs in the key."""
    try:
        parts = urlsplit(url)
        secret = parts.username is not None or parts.password is not None or bool(parts.query or parts.fragment)
        good = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        secret, good = "@" in url or "?" in url, False
    if secret:
        raise InputError(
            f"{name}: holds a name, a password, or what follows a ?; keys belong in vlm.key or {KEY_VARIABLE}"
        )
    if not good or not url.isprintable() or " " in url:
        raise InputError(f"{name}: expected http://… or https://…, got {url[:80]!r}")


class VlmServer:
    """A server that answers."""

    def __init__(self, config: VlmConfig) -> None:
        try:
            import openai
        except ImportError as error:
            raise InputError(
                "ask: the openai package is missing: pip install 'gsencoder[vlm]', or give dry_run=true"
            ) from error
        self.url = config.base_url or os.environ.get(URL_VARIABLE, "")
        if not self.url:
            raise InputError(
                f"vlm.base_url: say where the model's server is (http://localhost:8000/v1), here or in {URL_VARIABLE}; "
                "dry_run=true writes the prompt and the pictures without one"
            )
        check_url(self.url, "base_url" if config.base_url else URL_VARIABLE)
        self._config = config
        # A key that was read from a file ends with a line break.
        key = (config.key or os.environ.get(KEY_VARIABLE, "")).strip()
        if not (key.isascii() and key.isprintable()):
            raise InputError(f"vlm.key (or {KEY_VARIABLE}): holds characters that no key has")
        self._key = KeyFilter(key)
        try:
            # Nothing is sent where a redirect leads: nobody named that server.
            http = openai.DefaultHttpxClient(follow_redirects=False)
            # openai closes only the client that it makes itself.
            weakref.finalize(self, http.close)
            self._client = openai.OpenAI(
                base_url=self.url,
                # Servers at home take any key, but the client must have one.
                api_key=key or "none",
                timeout=config.timeout,
                max_retries=config.retries,
                http_client=http,
            )
        except Exception as error:  # settings of proxies and certificates raise whatever they like
            reason = self._key.clean(_cause(error), MAX_MESSAGE)
            raise InputError(f"vlm: no connection can be set up ({reason})") from self._without_key(error)

    def ask(self, body: Mapping[str, Any]) -> Reply:
        """One answer."""
        begun = time.monotonic()
        heard, failed = _Heard(), list[BaseException]()

        def listen() -> None:
            try:
                with self._client.chat.completions.create(**body) as stream:
                    for chunk in stream:
                        heard.hear(chunk)
            except BaseException as error:
                failed.append(error)

        if not _ends_within(self._config.longest, listen):
            raise self._fault(f"the answer took more than {self._config.longest:g} s (vlm.longest)", ServerError)
        if failed:
            raise self._failure(failed[0], heard) from self._without_key(failed[0])
        if not heard.parts:
            raise self._fault("sent nothing that is a chat completion; such addresses mostly end in /v1", ServerError)
        if not heard.finish:
            raise self._fault(f"the answer was cut off after {len(heard.text)} characters", ServerError)
        if problem := heard.problem():
            raise self._fault(problem, InputError)
        return Reply(
            text=self._key.clean(heard.text),
            model=self._key.clean(heard.model or str(body["model"]), MAX_NAME),
            finish=self._key.clean(heard.finish, MAX_NAME),
            tokens={name: count for name, count in (heard.tokens or {}).items() if not self._key.is_in(str(count))},
            seconds=time.monotonic() - begun,
        )

    def _failure(self, error: BaseException, heard: _Heard) -> InputError:
        """What went wrong, for people."""
        import openai

        message = _cause(error)
        if isinstance(error, openai.APITimeoutError):
            return self._fault(f"was silent for {self._config.timeout:g} s (vlm.timeout)", ServerError)
        if isinstance(error, openai.APIStatusError):
            return self._status(error.status_code, message, error.response.headers.get("location", ""))
        if isinstance(error, openai.APIConnectionError) and not heard.parts:
            return self._fault(
                f"no server answers there ({message}); start one, or correct vlm.base_url; "
                "dry_run=true writes the prompt and the pictures without one",
                ServerError,
            )
        return self._fault(
            f"the answer broke off after {len(heard.text)} characters, or is no chat completion: {message}", ServerError
        )

    def _status(self, code: int, message: str, location: str) -> InputError:
        if 300 <= code < 400:
            hint = "give that address as vlm.base_url if you trust it"
            message = f"redirects to {location[:120]} ({code}), where nothing is sent; {hint}"
            return self._fault(message, ServerError)
        if code in (401, 403):
            return self._fault(f"refuses the key ({code}: {message}); give vlm.key= or {KEY_VARIABLE}", ServerError)
        if code == 404:
            return self._fault(f"has no model of that name, or no chat at this address ({message})", ServerError)
        if code == 429 or code >= 500:
            return self._fault(f"failed {self._config.retries + 1} times ({code}: {message})", ServerError)
        return self._fault(f"refuses the request ({code}: {message})", InputError)

    def _fault(self, message: str, kind: type[InputError]) -> InputError:
        return kind(self._key.clean(f"the server at {self.url}: ") + self._key.clean(message, MAX_MESSAGE))

    def _without_key(self, error: BaseException) -> BaseException | None:
        """An error as the cause of ours, unless a traceback of it could show the key."""
        return None if self._key.is_in("".join(traceback.format_exception(error))) else error


def _ends_within(seconds: float, work: Callable[[], None]) -> bool:
    """Whether work in a thread of its own has ended after this many seconds; else it is left alone. A connection that
    stays alive without a word differs from an answer by the clock alone, and from outside."""
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(seconds)
    return not thread.is_alive()
