"""The server of the page: one machine, one token, and nothing of the disk but what was loaded.

An address is /TOKEN/REST. A request is refused (403) unless its token and its Host header are those of this server, so
that neither other users of the machine nor pages of other sites that resolve their name to this machine reach it. No
path names a file: there are

    GET   /                      the page
    GET   /scene/K               a scene (`gsencoder.infer.page.page`)
    GET   /labels/K              the best word of each Gaussian
    GET   /photograph/K/V        the photograph of a view, as JPEG
    POST  /ask                   {"scene", "word"}: relevancy of all Gaussians, and the threshold
    POST  /boxes                 {"scene", "word", "threshold"}: boxes and probabilities; null = the default threshold
    POST  /words                 {"scene", "rows"}: the known words nearest to some Gaussians
"""

import hmac
import json
import secrets
import socket
import sys
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from gsencoder.core.errors import InputError
from gsencoder.core.files import json_bytes
from gsencoder.infer.page.page import Container, jpeg_of
from gsencoder.infer.page.search import RELEVANCY_STEP, UNSEEN, SceneSearch

MAX_BODY = 64 << 10
"""Largest body of a request, bytes: a word, or a few thousand numbers of Gaussians."""
MAX_WORD = 500
"""Largest number of characters of a word."""
MAX_ROWS = 4096
PHOTOGRAPH_SIDE = 1280
TIMEOUT = 30.0
"""Seconds that a connection may be silent."""
CHUNK = 1 << 20
"""Bytes of an answer that are sent at once."""
LOOPBACK = ("127.0.0.1", "localhost", "::1")
BINARY = "application/octet-stream"


class RefusedError(Exception):
    """A request that is answered with an error; the message is for the page."""

    def __init__(self, status: HTTPStatus, message: str) -> None:
        super().__init__(message)
        self.status = status


class ViewServer(ThreadingHTTPServer):
    """Serves one page over one or two scenes."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(
        self,
        page: tuple[bytes, str],
        searches: Sequence[SceneSearch],
        scenes: Sequence[Container],
        *,
        host: str = "127.0.0.1",
        port: int = 0,
    ) -> None:
        """Args:
        page: the HTML, and the content security policy of its response.
        scenes: what the page gets of each.
        port: 0 = any that is free."""
        self.page, self.searches = page, tuple(searches)
        self.scene_bytes = [scene.to_bytes() for scene in scenes]
        self.token = secrets.token_urlsafe(24)
        if ":" in host:
            self.address_family = socket.AF_INET6
        try:
            super().__init__((host, port), _Handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(
                f"host={host} port={port}: cannot listen there: {reason}; port=0 takes a free one"
            ) from error
        names = {host, *(LOOPBACK if host in LOOPBACK else ())}
        number = self.server_address[1]
        self.hosts = frozenset(f"[{name}]:{number}" if ":" in name else f"{name}:{number}" for name in names)
        shown = f"[{host}]" if ":" in host else host
        self.address = f"http://{shown}:{number}/{self.token}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Reports a bug; a client that has gone is none."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)

    def search_of(self, value: Any) -> SceneSearch:
        """The scene of a request."""
        if type(value) is not int or not 0 <= value < len(self.searches):
            raise RefusedError(HTTPStatus.BAD_REQUEST, f"scene: expected a number below {len(self.searches)}")
        return self.searches[value]


class _Handler(BaseHTTPRequestHandler):
    server: ViewServer
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "gsencoder", ""
    timeout = TIMEOUT

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post)

    def do_other(self) -> None:
        self._answer(self._other)

    # Without these, the standard library answers before the token is compared.
    do_HEAD = do_PUT = do_DELETE = do_PATCH = do_OPTIONS = do_TRACE = do_other

    def _answer(self, make: Callable[[list[str]], tuple[bytes, str]]) -> None:
        try:
            data, kind = make(self._checked_path())
            status = HTTPStatus.OK
        except RefusedError as error:
            status, (data, kind) = error.status, _json({"error": str(error)})
        except InputError as error:
            status, (data, kind) = HTTPStatus.UNPROCESSABLE_ENTITY, _json({"error": str(error)})
        if status != HTTPStatus.OK:
            # A body that was not read would be taken for the next request.
            self.close_connection = True
        try:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            if status == HTTPStatus.METHOD_NOT_ALLOWED:
                self.send_header("Allow", "GET, POST")
            self.send_header("Cache-Control", "no-store")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header("Referrer-Policy", "no-referrer")
            self.send_header("Cross-Origin-Resource-Policy", "same-origin")
            self.send_header("X-Frame-Options", "DENY")
            if kind.startswith("text/html"):
                self.send_header("Content-Security-Policy", self.server.page[1])
            if self.close_connection:
                self.send_header("Connection", "close")
            self.end_headers()
            if self.command != "HEAD":
                # A time limit is one of each write.
                for start in range(0, len(data), CHUNK):
                    self.wfile.write(memoryview(data)[start : start + CHUNK])
        except OSError:
            self.close_connection = True

    def _checked_path(self) -> list[str]:
        if self.headers.get("Host", "").lower() not in self.server.hosts:
            raise RefusedError(HTTPStatus.FORBIDDEN, "another Host header than this server's address")
        origin = self.headers.get("Origin")
        if origin is not None and origin.lower() not in {f"http://{host}" for host in self.server.hosts}:
            raise RefusedError(HTTPStatus.FORBIDDEN, "a request of another site")
        first, *rest = self.path.partition("?")[0].removeprefix("/").split("/")
        if not hmac.compare_digest(first.encode("utf-8", "replace"), self.server.token.encode()):
            raise RefusedError(HTTPStatus.FORBIDDEN, "another token than that of this server's address")
        return rest

    def _get(self, path: list[str]) -> tuple[bytes, str]:
        server = self.server
        match path:
            case [""]:
                return server.page[0], "text/html; charset=utf-8"
            case ["scene", number]:
                server.search_of(_parse_index(number))
                return server.scene_bytes[_parse_index(number)], BINARY
            case ["labels", number]:
                labels = server.search_of(_parse_index(number)).labels
                return Container(meta={"names": labels.names}, arrays={"numbers": labels.numbers}).to_bytes(), BINARY
            case ["photograph", number, view]:
                views = server.search_of(_parse_index(number)).display.scene.views
                return jpeg_of(views, _parse_index(view), PHOTOGRAPH_SIDE), "image/jpeg"
        raise RefusedError(HTTPStatus.NOT_FOUND, "there is nothing at this address")

    def _other(self, _: list[str]) -> tuple[bytes, str]:
        raise RefusedError(HTTPStatus.METHOD_NOT_ALLOWED, f"expected GET or POST, got {self.command}")

    def _post(self, path: list[str]) -> tuple[bytes, str]:
        if path not in (["ask"], ["boxes"], ["words"]):
            raise RefusedError(HTTPStatus.NOT_FOUND, "there is nothing at this address")
        request = self._body()
        search = self.server.search_of(request.get("scene"))
        if path == ["words"]:
            rows, count = request.get("rows"), len(search.display.gaussians)
            if (
                not isinstance(rows, list)
                or not 0 < len(rows) <= MAX_ROWS
                or not all(type(row) is int and 0 <= row < count for row in rows)
            ):
                raise RefusedError(
                    HTTPStatus.BAD_REQUEST, f"rows: expected up to {MAX_ROWS} numbers of Gaussians below {count}"
                )
            return _json({"words": search.best_words(rows)})
        word = request.get("word")
        if not isinstance(word, str) or not word.strip() or len(word) > MAX_WORD:
            raise RefusedError(HTTPStatus.BAD_REQUEST, f"word: expected a text of 1 to {MAX_WORD} characters")
        if path == ["boxes"]:
            cutoff = request.get("threshold")
            if cutoff is not None and not (isinstance(cutoff, (int, float)) and -1 <= cutoff <= 1):
                raise RefusedError(HTTPStatus.BAD_REQUEST, "threshold: expected a relevancy in [-1, 1]")
            return _json(search.boxes(word.strip(), cutoff))
        answer = search.ask(word.strip())
        meta = {"word": word.strip(), "threshold": answer.threshold, "step": RELEVANCY_STEP, "unseen": UNSEEN}
        return Container(meta=meta, arrays={"relevancy": answer.relevancy}).to_bytes(), BINARY

    def _body(self) -> Mapping[str, Any]:
        if self.headers.get("Content-Type", "").partition(";")[0].strip().lower() != "application/json":
            raise RefusedError(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "expected a body of application/json")
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()):
            raise RefusedError(HTTPStatus.LENGTH_REQUIRED, "expected a body and its Content-Length")
        if len(length) > 12 or int(length) > MAX_BODY:
            raise RefusedError(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"expected at most {MAX_BODY:,} bytes")
        try:
            request = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError, TimeoutError) as error:
            raise RefusedError(HTTPStatus.BAD_REQUEST, "the body is not JSON") from error
        if not isinstance(request, dict):
            raise RefusedError(HTTPStatus.BAD_REQUEST, "expected a JSON object")
        return request

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not logged: their addresses hold the token."""


def _parse_index(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 9):
        raise RefusedError(HTTPStatus.NOT_FOUND, "there is nothing at this address")
    return int(text)


def _json(value: Any) -> tuple[bytes, str]:
    return json_bytes(value)[0], "application/json"
