"""A vision-language model behind a server that speaks OpenAI's chat protocol: vLLM, transformers serve, llama.cpp's
server, a cloud.
"""

import importlib
import itertools
import os
import re
import threading
import time
import traceback
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from html.entities import html5
from typing import Any, Literal
from urllib.parse import urlsplit

from gsencoder.core.errors import InputError

LARGEST_REPLY = 1 << 22
"""Bytes of any reply: error pages and lists of models take at most a megabyte or two. JSON of empty lists takes fifty
times its bytes when it is parsed, so this is 200 MB of memory at worst."""
BYTES_PER_TOKEN = 1 << 10
"""Further bytes for each token of an answer: a streamed token comes in a JSON object of 200 to 500 bytes."""


class ReplyGuard:
    """A response hook of the HTTP client: it runs before the body is read and before a redirect is followed.

    It never raises, as the openai client would send the request again.

    Attributes:
        fault: why the last response was refused; empty where it was not.
    """

    def __init__(self, max_tokens: int) -> None:
        self.fault = ""
        self._largest = LARGEST_REPLY + BYTES_PER_TOKEN * max_tokens

    def __call__(self, response: Any) -> None:
        self.fault = ""
        self._check_redirect(response)
        headers, coding = response.headers, response.headers.get("content-encoding", "identity").strip().lower()
        length = headers.get("content-length", "")
        if coding not in ("", "identity"):
            # The client would unpack it before anybody could count its bytes.
            self._refuse(response, f"compressed its reply ({coding[:40]}), although it was asked not to")
            del headers["content-encoding"]
        elif length.isdecimal() and int(length[:20]) > self._largest:
            self._refuse(response, self._too_large())
        response.stream = _stream(response, self._bounded(response, response.stream))

    def _check_redirect(self, response: Any) -> None:
        """Redirects within the server are followed; others would take question and pictures to whom nobody named."""
        here, location = response.request.url, response.headers.get("location")
        if location is None or not 300 <= response.status_code < 400:
            return
        try:
            # Read as the client does, which mends an address without a host in its own way.
            there = type(here)(location)
            if there.scheme and not there.host:
                raise ValueError("an address without a host")
            there = here.join(there)
            same = _origin(there) == _origin(here)
            named = f"{there.scheme}://{there.netloc.decode('ascii', 'replace').rpartition('@')[2]}"
        except Exception:  # the client has errors of its own for each part of an address
            same, named = False, "what is no address"
        if not same:
            # Without the header nobody follows, and the client reports the status.
            del response.headers["location"]
            self._refuse(
                response,
                f"redirects to {named[:120]} ({response.status_code}), where nothing is sent; "
                "give that address as vlm.base_url if you trust it",
            )

    def _refuse(self, response: Any, fault: str) -> None:
        self.fault = self.fault or fault
        # openai's own header: no status of a reply that was refused is a reason to ask again.
        response.headers["x-should-retry"] = "false"

    def _too_large(self) -> str:
        return f"sent more than {self._largest:,} bytes, which no answer needs; the rest was not read"

    def _bounded(self, response: Any, body: Iterable[bytes]) -> Iterator[bytes]:
        """The parts of a body until they are too many; none of a reply that was refused."""
        size = 0
        for part in () if self.fault else body:
            size += len(part)
            if size > self._largest:
                self._refuse(response, self._too_large())
                return
            yield part


def _origin(url: Any) -> tuple[str, str, int | None]:
    default = {"http": 80, "https": 443}.get(url.scheme)
    return url.scheme, url.host, url.port or default


def _stream(response: Any, parts: Iterator[bytes]) -> Any:
    """A body of these parts that closes the response's own."""
    library = importlib.import_module(type(response).__module__.partition(".")[0])
    close: Callable[[], None] = response.stream.close

    class Bounded(library.SyncByteStream):  # type: ignore[name-defined]
        def __iter__(self) -> Iterator[bytes]:
            return parts

        def close(self) -> None:
            close()

    return Bounded()


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
        # Of a long key with letters that begin escapes, the letters are not always told apart.
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


MAX_TOKENS_COUNT = 1 << 53
"""Larger counts are no counts, and no number that every reader of JSON knows."""


class ServerError(InputError):
    """A fault of the server that another question would meet as well; any other `InputError` is about the question."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """What a model said.

    Attributes:
        model: as the server names it.
        finish: why it ended: "stop", "length" (max_tokens), …
        tokens: of prompt and answer, where the server counts them.
        seconds: from the request to the end of the answer.
    """

    text: str
    model: str
    finish: str
    tokens: dict[str, int]
    seconds: float


@dataclass(slots=True)
class Heard:
    """An answer as far as it has come.

    Attributes:
        refusal: the model's words where it refuses to answer.
        thought: whether there was reasoning beside the answer.
        parts: how many parts have come.
        unstreamed: whether JSON came in place of the stream that was asked for.
    """

    text: str = ""
    model: str = ""
    finish: str = ""
    tokens: dict[str, int] | None = None
    refusal: str = ""
    thought: bool = False
    parts: int = 0
    unstreamed: bool = False

    def hear(self, part: Any) -> None:
        """Takes up a completion, or a chunk of one."""
        choices = getattr(part, "choices", None)
        if choices is None:
            extra = getattr(part, "model_extra", None) or {}
            # Whole, as half a key could not be recognized; who reports it takes the key out and then cuts it.
            raise ValueError(str(extra.get("error") or extra.get("message") or extra.get("detail") or part))
        self.parts += 1
        self.model = str(getattr(part, "model", "") or self.model)
        self.tokens = _tokens(getattr(part, "usage", None)) or self.tokens
        # The last chunk of some servers counts tokens and has no choice.
        for choice in choices[:1]:
            message = getattr(choice, "delta", None) or getattr(choice, "message", None)
            self.text += _words(getattr(message, "content", None))
            self.refusal += _words(getattr(message, "refusal", None))
            self.thought |= bool(getattr(message, "reasoning_content", None) or getattr(message, "reasoning", None))
            self.finish = str(choice.finish_reason or self.finish)

    def wrong(self) -> str | None:
        """Why this is no answer, of a completion that has ended; None if it is one."""
        if self.refusal:
            return f"the model refuses: {self.refusal}"
        if self.finish == "content_filter":
            return f"a filter cut the answer off after {len(self.text)} characters"
        if self.text.strip():
            return None
        hints = {
            "length": f"it {'thought' if self.thought else 'went on'} until vlm.max_tokens; raise it",
            "tool_calls": "it calls a tool, and none is offered; switch tools off on the server, or take another model",
        }
        hint = hints.get(self.finish, "")
        return f"the answer holds no text (it ended with {self.finish!r})" + (f"; {hint}" if hint else "")


def _words(content: Any) -> str:
    """Text that comes as such, or in parts."""
    if isinstance(content, list):
        parts = [each.get("text") if isinstance(each, dict) else getattr(each, "text", None) for each in content]
        return "".join(part for part in parts if isinstance(part, str))
    return content if isinstance(content, str) else ""


def _tokens(usage: Any) -> dict[str, int]:
    counts = {"prompt": getattr(usage, "prompt_tokens", None), "answer": getattr(usage, "completion_tokens", None)}
    return {name: count for name, count in counts.items() if isinstance(count, int) and 0 <= count < MAX_TOKENS_COUNT}


def cause(error: BaseException) -> str:
    """What went wrong at the bottom: a server's message, or that of the first error."""
    extra = getattr(error, "body", None)
    for name in ("error", "message", "detail"):
        extra = extra.get(name, extra) if isinstance(extra, dict) else extra
    if extra:
        return " ".join(str(extra).split())
    deepest = error
    while deepest.__cause__ is not None or deepest.__context__ is not None:
        deepest = deepest.__cause__ or deepest.__context__  # type: ignore[assignment]
    return " ".join(str(deepest).split()) or type(deepest).__name__


URL_VARIABLE, KEY_VARIABLE, MODEL_VARIABLE = "OPENAI_BASE_URL", "OPENAI_API_KEY", "GSENCODER_VLM_MODEL"
MAX_MESSAGE = 300
"""Characters of a server's message that an error repeats."""
MAX_NAME = 200
"""Characters of a server's name for its model, or for why an answer ended, that are written down."""
MAX_MODELS_LISTED = 8
"""Models of a server that an error lists."""

Message = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class VlmConfig:
    """Where the model is and how it is asked."""

    base_url: str = field(
        default="", metadata={"help": f"of the server, such as http://localhost:8000/v1; empty = {URL_VARIABLE}"}
    )
    key: str = field(
        default="",
        metadata={"help": f"the server's key; empty = {KEY_VARIABLE}; it is never written anywhere", "secret": True},
    )
    model: str = field(default="", metadata={"help": f"the model's name on the server; empty = {MODEL_VARIABLE}"})
    timeout: float = field(default=60.0, metadata={"help": "seconds that the server may be silent"})
    longest: float = field(default=600.0, metadata={"help": "seconds that an answer may take in all, retries included"})
    retries: int = field(default=2, metadata={"help": "times that a busy or failing server is asked again"})
    stream: bool = field(default=True, metadata={"help": "take the answer word by word"})
    max_tokens: int = field(default=512, metadata={"help": "tokens of the answer"})
    limit_by: Literal["max_tokens", "max_completion_tokens"] = field(
        default="max_tokens", metadata={"help": "the name that the server has for max_tokens"}
    )
    temperature: float | None = field(
        default=0.0, metadata={"help": "0 = the likeliest answer; empty = the server's, where it takes no other"}
    )
    image_side: int = field(default=768, metadata={"help": "longer side of the pictures that are sent, pixels"})
    image_format: Literal["jpeg", "png"] = field(
        default="jpeg", metadata={"help": "of the pictures that are sent; png is exact and larger"}
    )

    def __post_init__(self) -> None:
        for name in ("timeout", "longest"):
            if not 0 < getattr(self, name) < float("inf"):
                raise InputError(f"{name}: expected a positive number of seconds, got {getattr(self, name)}")
        if not 0 <= self.retries <= 100:
            raise InputError(f"retries: expected 0 to 100, got {self.retries}")
        if self.max_tokens < 1:
            raise InputError(f"max_tokens: expected 1 or more, got {self.max_tokens}")
        if self.temperature is not None and not 0 <= self.temperature <= 2:
            raise InputError(f"temperature: expected 0 to 2, got {self.temperature}")
        if not 16 <= self.image_side <= 8192:
            raise InputError(f"image_side: expected 16 to 8192 pixels, got {self.image_side}")
        if self.base_url:
            check_url(self.base_url, "base_url")


def request_body(messages: Sequence[Message], config: VlmConfig, *, named: bool = True) -> dict[str, Any]:
    """What is sent, but for the key.

    Args:
        named: a model must be named; a dry run needs none.
    """
    model = config.model or os.environ.get(MODEL_VARIABLE, "")
    if named and not model:
        raise InputError(f"vlm.model: name the model that the server has, here or in {MODEL_VARIABLE}")
    body: dict[str, Any] = {"model": model, "messages": list(messages), config.limit_by: config.max_tokens}
    if config.temperature is not None:
        body["temperature"] = config.temperature
    body["stream"] = config.stream
    if config.stream:
        # Without it some servers count no tokens.
        body["stream_options"] = {"include_usage": True}
    return body


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
        self._guard = ReplyGuard(config.max_tokens)
        try:
            # A transport of our own would have to read the settings of proxies itself; a hook does not.
            http = openai.DefaultHttpxClient(event_hooks={"response": [self._guard]})
            # openai closes only the client that it makes itself.
            weakref.finalize(self, http.close)
            # Servers at home take any key, but the client must have one.
            self._client = openai.OpenAI(
                base_url=self.url,
                api_key=key or "none",
                timeout=config.timeout,
                max_retries=config.retries,
                default_headers={"Accept-Encoding": "identity"},
                http_client=http,
            )
        except Exception as error:  # settings of proxies and certificates raise whatever they like
            reason = self._key.clean(cause(error), MAX_MESSAGE)
            raise InputError(f"vlm: no connection can be set up ({reason}){_proxies()}") from self._downscaled(error)

    def ask(self, body: Mapping[str, Any]) -> Reply:
        """One answer."""
        begun = time.monotonic()
        heard, failed = Heard(), list[BaseException]()
        self._guard.fault = ""

        def listen() -> None:
            try:
                self._listen(body, heard)
            except BaseException as error:
                failed.append(error)

        if not _ends_within(self._config.longest, listen):
            raise self._fault(f"the answer took more than {self._config.longest:g} s (vlm.longest)", ServerError)
        if self._guard.fault:
            raise self._fault(self._guard.fault, ServerError)
        if failed:
            raise self._failure(failed[0], heard) from self._downscaled(failed[0])
        if heard.unstreamed:
            raise self._fault(
                "sent nothing that is a chat completion, but JSON in place of the stream that was asked for; give "
                "vlm.stream=false, or an address that ends in /v1, as most do",
                ServerError,
            )
        if not heard.parts:
            raise self._fault("sent nothing that is a chat completion; such addresses mostly end in /v1", ServerError)
        if not heard.finish:
            raise self._fault(f"the answer was cut off after {len(heard.text)} characters", ServerError)
        wrong = heard.wrong()
        if wrong:
            raise self._fault(wrong, InputError)
        return self._reply(heard, str(body["model"]), time.monotonic() - begun)

    def _reply(self, heard: Heard, model: str, seconds: float) -> Reply:
        """What was heard, without the key in any of it."""
        return Reply(
            text=self._key.clean(heard.text),
            model=self._key.clean(heard.model or model, MAX_NAME),
            finish=self._key.clean(heard.finish, MAX_NAME),
            tokens={name: count for name, count in (heard.tokens or {}).items() if not self._key.is_in(str(count))},
            seconds=seconds,
        )

    def _listen(self, body: Mapping[str, Any], heard: Heard) -> None:
        completion = self._client.chat.completions.create(**body)
        if not body["stream"]:
            heard.hear(completion)
            return
        with completion as stream:
            for chunk in stream:
                heard.hear(chunk)
            kind = stream.response.headers.get("content-type", "")
        heard.unstreamed = not heard.parts and kind.partition(";")[0].strip().lower() == "application/json"

    def _failure(self, error: BaseException, heard: Heard) -> InputError:
        """What went wrong, for people."""
        import openai

        if isinstance(error, openai.APITimeoutError):
            times = f", {self._config.retries + 1} times" if self._config.retries and not heard.parts else ""
            return self._fault(f"was silent for {self._config.timeout:g} s{times} (vlm.timeout)", ServerError)
        message = cause(error)
        if isinstance(error, openai.APIStatusError):
            return self._status(error.status_code, message)
        after = f" after {len(heard.text)} characters" if heard.text else ""
        if isinstance(error, openai.APIConnectionError) and not heard.parts:
            return self._fault(
                f"no server answers there ({message}){_proxies()}; start one, or correct vlm.base_url; "
                "dry_run=true writes the prompt and the pictures without one",
                ServerError,
            )
        if isinstance(error, openai.APIConnectionError):
            return self._fault(f"the answer broke off{after}: {message}", ServerError)
        return self._fault(f"the answer broke off{after}, or is no chat completion: {message}", ServerError)

    def _status(self, code: int, message: str) -> InputError:
        if code in (401, 403):
            return self._fault(f"refuses the key ({code}: {message}); give vlm.key= or {KEY_VARIABLE}", ServerError)
        if code == 404:
            return self._fault(
                f"has no model of that name, or no chat at this address ({message}){self._models()}", ServerError
            )
        if code == 429 or code >= 500:
            return self._fault(f"failed {self._config.retries + 1} times ({code}: {message})", ServerError)
        return self._fault(f"refuses the request ({code}: {message})", InputError)

    def _models(self) -> str:
        """The names that the server has, where it tells."""
        names: list[str] = []

        def listen() -> None:
            try:
                models = self._client.with_options(max_retries=0).models.list()
                names.extend(str(model.id) for model in itertools.islice(models, MAX_MODELS_LISTED))
            except Exception:  # it is only a hint
                return

        if not _ends_within(self._config.timeout, listen) or self._guard.fault or not names:
            return ""
        return f"; it has {', '.join(names)}"

    def _fault(self, message: str, kind: type[InputError]) -> InputError:
        return kind(self._key.clean(f"the server at {self.url}: ") + self._key.clean(message, MAX_MESSAGE))

    def _downscaled(self, error: BaseException) -> BaseException | None:
        """An error as the cause of ours, unless a traceback of it could show the key."""
        return None if self._key.is_in("".join(traceback.format_exception(error))) else error


def _ends_within(seconds: float, work: Callable[[], None]) -> bool:
    """Whether work in a thread of its own has ended after so many seconds; else it is left alone. A connection that
    stays alive without a word is told from an answer by the clock alone, and from outside."""
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(seconds)
    return not thread.is_alive()


def _proxies() -> str:
    """Which variables lead elsewhere."""
    names = ("all_proxy", "http_proxy", "https_proxy")
    variables = [name for each in names for name in (each, each.upper()) if os.environ.get(name)]
    return (
        f"; {' and '.join(variables)} {'lead' if len(variables) > 1 else 'leads'} through a proxy (NO_PROXY names "
        "exceptions)"
        if variables
        else ""
    )
