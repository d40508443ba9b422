"""Requests to the server of `view`, as tests send them."""

import http.client
import json
import socket
from typing import Any

from gsencoder.infer.page.server import ViewServer


class Connection(http.client.HTTPConnection):
    """Sends any letters of a path, which the library refuses."""

    def _encode_request(self, request: str) -> bytes:
        return request.encode("utf-8")


def call(
    server: ViewServer, method: str, path: str, body: Any = None, *, headers: dict[str, str] | None = None
) -> tuple[int, bytes, http.client.HTTPMessage]:
    """An answer to a request to a path behind the token; a body that is no bytes is sent as JSON."""
    connection = Connection(server.server_address[0], server.server_address[1], timeout=10)
    data = body if isinstance(body, bytes) or body is None else json.dumps(body).encode()
    sent = {"Content-Type": "application/json"} if data is not None else {}
    connection.request(method, path, data, sent | (headers or {}))
    response = connection.getresponse()
    read = response.read()
    connection.close()
    return response.status, read, response.headers


def at(server: ViewServer, rest: str) -> str:
    return f"/{server.token}/{rest}"


def connected(server: ViewServer) -> socket.socket:
    """A connection on which nothing was sent."""
    return socket.create_connection((str(server.server_address[0]), server.server_address[1]), timeout=10)


def sent(server: ViewServer, text: str) -> bytes:
    """All that comes back for the bytes of a request, until the server closes the connection."""
    with connected(server) as stream:
        stream.sendall(text.encode())
        parts = []
        while part := stream.recv(1 << 16):
            parts.append(part)
    return b"".join(parts)


def head(server: ViewServer, method: str, rest: str, *lines: str) -> str:
    """The lines of a request before its body."""
    host, port = server.server_address[:2]
    return "\r\n".join([f"{method} {at(server, rest)} HTTP/1.1", f"Host: {host}:{port}", *lines, "", ""])
