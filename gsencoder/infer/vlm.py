"""A vision-language model behind a server that speaks OpenAI's chat protocol: vLLM, transformers serve, llama.cpp's
server, a cloud."""

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from gsencoder.errors import InputError

URL_VARIABLE, KEY_VARIABLE, MODEL_VARIABLE = "OPENAI_BASE_URL", "OPENAI_API_KEY", "GSENCODER_VLM_MODEL"
LONGEST_TOLD = 300
"""Characters of a server's message that an error repeats."""
LEAST_KEY = 6
"""Keys shorter than that are placeholders, which servers at home are given; anything may hold their letters."""

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
    longest: float = field(default=600.0, metadata={"help": "seconds that an answer may take in all"})
    retries: int = field(default=2, metadata={"help": "times that a busy or failing server is asked again"})
    stream: bool = field(default=True, metadata={"help": "take the answer word by word"})
    max_tokens: int = field(default=512, metadata={"help": "tokens of the answer"})
    temperature: float = field(default=0.0, metadata={"help": "0 = the likeliest answer"})
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
        if not 0 <= self.temperature <= 2:
            raise InputError(f"temperature: expected 0 to 2, got {self.temperature}")
        if not 16 <= self.image_side <= 8192:
            raise InputError(f"image_side: expected 16 to 8192 pixels, got {self.image_side}")
        if self.base_url and not self.base_url.startswith(("http://", "https://")):
            raise InputError(f"base_url: expected http://… or https://…, got {self.base_url[:80]!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """What a model said.

    Attributes:
        text: the answer.
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


def request_body(messages: Sequence[Message], config: VlmConfig, *, named: bool = True) -> dict[str, Any]:
    """What is sent, but for the key.

    Args:
        messages: of `prompts.messages`.
        config: see there.
        named: a model must be named; a dry run needs none.

    Raises:
        InputError: no model is named.
    """
    model = config.model or os.environ.get(MODEL_VARIABLE, "")
    if named and not model:
        raise InputError(f"vlm.model: name the model that the server has, here or in {MODEL_VARIABLE}")
    return {
        "model": model,
        "messages": list(messages),
        "max_tokens": config.max_tokens,
        "temperature": config.temperature,
        "stream": config.stream,
    }


class VlmServer:
    """A server that answers.

    Attributes:
        url: where it is.
    """

    def __init__(self, config: VlmConfig) -> None:
        """Args:
        config: see there; what it leaves empty comes from the environment.

        Raises:
            InputError: no address, or the openai package is missing.
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
        self._config = config
        self._key = config.key or os.environ.get(KEY_VARIABLE, "")
        # Servers at home take any key, but the client must have one.
        self._client = openai.OpenAI(
            base_url=self.url, api_key=self._key or "none", timeout=config.timeout, max_retries=config.retries
        )

    def ask(self, body: Mapping[str, Any]) -> Reply:
        """One answer.

        Args:
            body: of `request_body`.

        Raises:
            InputError: whatever keeps the server from a whole answer, in its own words where it has any.
        """
        import openai

        begun = time.monotonic()
        text, model, finish, tokens = "", str(body["model"]), "", dict[str, int]()
        try:
            for part in self._streamed(body, begun) if body["stream"] else self._at_once(body):
                text += part.text
                model, finish, tokens = part.model or model, part.finish or finish, part.tokens or tokens
        except InputError:
            raise
        except openai.APITimeoutError as error:
            raise self._refusal(f"was silent for {self._config.timeout:g} s (vlm.timeout)") from error
        except openai.APIConnectionError as error:
            if text:
                raise self._refusal(f"the answer broke off after {len(text)} characters: {_cause(error)}") from error
            raise self._refusal(
                f"no server answers there ({_cause(error)}); start one, or correct vlm.base_url; "
                "dry_run=true writes the prompt and the pictures without one"
            ) from error
        except openai.APIStatusError as error:
            raise self._refusal(self._status(error)) from error
        except Exception as error:  # transport and parsing raise classes of the client's own dependencies
            after = f" after {len(text)} characters" if text else ""
            raise self._refusal(f"the answer broke off{after}, or is no chat completion: {_cause(error)}") from error
        if not finish:
            raise self._refusal(f"the answer was cut off after {len(text)} characters")
        if not text.strip():
            raise self._refusal(f"the answer is empty (it ended with {finish!r})")
        return Reply(text=text, model=model, finish=finish, tokens=tokens, seconds=time.monotonic() - begun)

    def _at_once(self, body: Mapping[str, Any]) -> Iterator["_Part"]:
        found = self._client.chat.completions.create(**body)
        if not getattr(found, "choices", None):
            raise ValueError(f"no choices in {str(found)[:LONGEST_TOLD]!r}")
        choice = found.choices[0]
        text = choice.message.content or ""
        yield _Part(text, found.model or "", choice.finish_reason or "", _tokens(found.usage))

    def _streamed(self, body: Mapping[str, Any], begun: float) -> Iterator["_Part"]:
        with self._client.chat.completions.create(**body) as stream:
            for chunk in stream:
                if time.monotonic() - begun > self._config.longest:
                    raise self._refusal(f"the answer took more than {self._config.longest:g} s (vlm.longest)")
                tokens = _tokens(getattr(chunk, "usage", None))
                # The last chunk of some servers counts tokens and has no choice.
                choice = chunk.choices[0] if chunk.choices else None
                text = choice.delta.content or "" if choice is not None and choice.delta is not None else ""
                yield _Part(text, chunk.model or "", (choice.finish_reason or "") if choice is not None else "", tokens)

    def _status(self, error: Any) -> str:
        told = _cause(error)
        if error.status_code in (401, 403):
            return f"refuses the key ({error.status_code}: {told}); give vlm.key= or {KEY_VARIABLE}"
        if error.status_code == 404:
            return f"has no model of that name, or no chat at this address ({told}){self._models()}"
        if error.status_code == 429 or error.status_code >= 500:
            return f"failed {self._config.retries + 1} times ({error.status_code}: {told})"
        return f"refuses the request ({error.status_code}: {told})"

    def _models(self) -> str:
        """The names that the server has, where it tells."""
        try:
            names = [each.id for each in self._client.with_options(max_retries=0).models.list()]
        except Exception:  # it is only a hint
            return ""
        return f"; it has {', '.join(names[:8])}" if names else ""

    def _refusal(self, told: str) -> InputError:
        message = f"the server at {self.url}: {told}"
        # A server may repeat what it was sent.
        return InputError(message.replace(self._key, "(key)") if len(self._key) >= LEAST_KEY else message)


@dataclass(frozen=True, slots=True)
class _Part:
    text: str
    model: str
    finish: str
    tokens: dict[str, int]


def _tokens(usage: Any) -> dict[str, int]:
    names = {"prompt": "prompt_tokens", "answer": "completion_tokens"}
    return {} if usage is None else {name: int(getattr(usage, key, 0) or 0) for name, key in names.items()}


def _cause(error: BaseException) -> str:
    """What went wrong at the bottom, in a line."""
    told = getattr(error, "body", None)
    for name in ("error", "message", "detail"):
        told = told.get(name, told) if isinstance(told, dict) else told
    if told:
        return " ".join(str(told).split())[:LONGEST_TOLD]
    deepest = error
    while deepest.__cause__ is not None or deepest.__context__ is not None:
        deepest = deepest.__cause__ or deepest.__context__  # type: ignore[assignment]
    return (" ".join(str(deepest).split()) or type(deepest).__name__)[:LONGEST_TOLD]
