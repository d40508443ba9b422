"""Limits on the replies and the redirects of a chat server."""

import importlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any

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
        """Args:
        max_tokens: of an answer.
        """
        self.fault = ""
        self._largest = LARGEST_REPLY + BYTES_PER_TOKEN * max_tokens

    def __call__(self, response: Any) -> None:
        """Args:
        response: of httpx, or of httpx2 since openai 3.
        """
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
