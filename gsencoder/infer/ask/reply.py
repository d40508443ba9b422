"""Replies of chat servers, parsed without trusting them."""

from dataclasses import dataclass
from typing import Any

from gsencoder.core.errors import InputError

MAX_TOKENS_COUNT = 1 << 53
"""Larger counts are no counts, and no number that every reader of JSON knows."""


class ServerError(InputError):
    """A fault of the server that another question would meet as well; any other `InputError` is about the question."""


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


@dataclass(slots=True)
class Heard:
    """An answer as far as it has come.

    Attributes:
        text, model, finish, tokens: as in `Reply`.
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
        """Takes up a completion, or a chunk of one.

        Raises:
            ValueError: the server tells of an error, or it is no part of a completion.
        """
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
