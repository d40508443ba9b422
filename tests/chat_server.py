"""A server that speaks as much of the chat protocol as a test wants, and misbehaves on demand."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


class Handler(BaseHTTPRequestHandler):
    """Calls `self.server.behave(handler, body)` for each POST."""

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        headers = {name.lower(): value for name, value in self.headers.items()}
        self.server.requests.append((headers, body))  # type: ignore[attr-defined]
        self.server.behave(self, body)  # type: ignore[attr-defined]

    def do_GET(self) -> None:
        self.server.listing(self)  # type: ignore[attr-defined]

    def reply(self, status: int, value: Any) -> None:
        self.raw(status, json.dumps(value).encode(), "application/json")

    def raw(self, status: int, data: bytes, kind: str, *, length: int | None = None) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data) if length is None else length))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_: Any) -> None:
        pass


def completion(text: str | None, finish: str | None = "stop") -> dict[str, Any]:
    """A whole answer."""
    return {
        "id": "1",
        "object": "chat.completion",
        "created": 0,
        "model": "tiny",
        "choices": [{"index": 0, "finish_reason": finish, "message": {"role": "assistant", "content": text}}],
        "usage": {"prompt_tokens": 7, "completion_tokens": 2, "total_tokens": 9},
    }


def events(*texts: str, finish: str | None = "stop", done: bool = True) -> bytes:
    """An answer in pieces."""
    lines = []
    for number, text in enumerate([*texts, ""]):
        last = number == len(texts)
        if last and finish is None:
            break
        choice = {"index": 0, "delta": {"content": text}, "finish_reason": finish if last else None}
        chunk = {"id": "1", "object": "chat.completion.chunk", "created": 0, "model": "tiny", "choices": [choice]}
        lines.append(f"data: {json.dumps(chunk)}\n\n")
    return ("".join(lines) + ("data: [DONE]\n\n" if done else "")).encode()


def answer(text: str) -> Callable[[Handler, Any], None]:
    """Answers every request with a text in pieces, and counts tokens."""

    def behave(handler: Handler, _: Any) -> None:
        chunk = {"id": "1", "object": "chat.completion.chunk", "created": 0, "model": "tiny", "choices": []}
        usage = json.dumps(chunk | {"usage": completion("")["usage"]})
        data = events(*(text[start : start + 3] for start in range(0, len(text), 3)), done=False)
        handler.raw(200, data + f"data: {usage}\n\ndata: [DONE]\n\n".encode(), "text/event-stream")

    return behave


def silent(seconds: float) -> Callable[[Handler, Any], None]:
    """Says nothing for a while."""

    def behave(handler: Handler, body: Any) -> None:
        time.sleep(seconds)
        answer("late")(handler, body)

    return behave


def one_model(handler: Handler) -> None:
    """Lists the models of a server."""
    handler.reply(200, {"object": "list", "data": [{"id": "tiny", "object": "model", "created": 0, "owned_by": "x"}]})


class Server(ThreadingHTTPServer):
    """Keeps what it was sent."""

    daemon_threads = True

    def __init__(self, behave: Callable[[Handler, Any], None]) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.behave = behave
        self.listing: Callable[[Handler], None] = one_model
        self.requests: list[tuple[dict[str, str], dict[str, Any]]] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/v1"

    def handle_error(self, *_: Any) -> None:
        """Clients that went away are no error here."""


@contextmanager
def serving(behave: Callable[[Handler, Any], None]) -> Iterator[Server]:
    """A server while the block lasts."""
    server = Server(behave)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
