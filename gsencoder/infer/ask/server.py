"""A vision-language model behind a server that speaks OpenAI's chat protocol: vLLM, transformers serve, llama.cpp's
server, a cloud."""

import itertools
import os
import threading
import time
import traceback
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal
from urllib.parse import urlsplit

from gsencoder.core.errors import InputError
from gsencoder.infer.ask.http_limits import ReplyGuard
from gsencoder.infer.ask.key_filter import KeyFilter
from gsencoder.infer.ask.reply import Heard, Reply, ServerError, cause

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
        messages: of `prompts.messages`.
        config: settings.
        named: a model must be named; a dry run needs none.

    Raises:
        InputError: no model is named.
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
    """Complains about what is no server's address, or holds what belongs in the key.

    Raises:
        InputError: which never repeats the address where it may hold a key.
    """
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
    """A server that answers.

    Attributes:
        url: where it is.
    """

    def __init__(self, config: VlmConfig) -> None:
        """Args:
        config: see there; what it leaves empty comes from the environment.

        Raises:
            InputError: no address or a wrong one, a key that cannot be sent, or the openai package is missing.
        """
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
        """One answer.

        Args:
            body: of `request_body`.

        Raises:
            ServerError: the server cannot be reached, fails, or breaks off.
            InputError: it refuses this question, or gives no whole answer to it; in its own words where it has any.
        """
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
