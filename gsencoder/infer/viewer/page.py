"""The HTML of the page: script and style inline, and for a file the scenes. Nothing is loaded from anywhere else."""

import base64
import gzip
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from gsencoder.core.files import plain
from gsencoder.infer.viewer.bundle import Bundle
from gsencoder.infer.viewer.container import Container

COMPRESSION = 6


def json_in_script(value: Any) -> str:
    """JSON that may stand in a <script> element, whatever text it holds: <, >, & and the line separators of
    JavaScript are escaped, so that no text can end the element or begin another one."""
    # ASCII alone: lone surrogates of file names and the line separators are escaped with it.
    text = json.dumps(plain(value), ensure_ascii=True, allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def served_page(bundle: Bundle, title: str, settings: Mapping[str, Any]) -> tuple[bytes, str]:
    """The page of a server, and the content security policy that its response states.

    Args:
        bundle: script and style.
        title: of the page, for people.
        settings: for the script: `kind` is "server", and `scenes` the number of scenes.
    """
    policy = content_policy(bundle, connect="'self'")
    return _html(bundle, title, settings, [], "").encode("utf-8", "replace"), policy


def file_page(bundle: Bundle, title: str, settings: Mapping[str, Any], scenes: Sequence[Container]) -> bytes:
    """The page as one file with its scenes, which opens without a network.

    Args:
        bundle: script and style.
        title: of the page.
        settings: for the script.
        scenes: of `file_container`.
    """
    blobs = [gzip.compress(scene.to_bytes(), COMPRESSION, mtime=0) for scene in scenes]
    parts = [
        f'<script type="application/octet-stream" id="scene-{number}">{base64.b64encode(blob).decode("ascii")}</script>'
        for number, blob in enumerate(blobs)
    ]
    policy = content_policy(bundle, connect="'none'")
    return _html(bundle, title, settings, parts, policy).encode("utf-8", "replace")


def content_policy(bundle: Bundle, *, connect: str) -> str:
    """What the page may do: run its own script, compile the sorting of its library, and draw."""
    script, style = (
        base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
        for text in (_script(bundle), bundle.style)
    )
    return (
        f"default-src 'none'; script-src 'sha256-{script}' 'wasm-unsafe-eval'; style-src 'sha256-{style}'; "
        f"img-src blob: data:; worker-src blob: data:; connect-src {connect}; base-uri 'none'; "
        "form-action 'none'"
    )


def _script(bundle: Bundle) -> str:
    # In a script element these would end it, in any case of letters, or hide its end.
    return re.sub(r"</(?=script)", r"<\\/", bundle.script, flags=re.IGNORECASE).replace("<!--", "<\\!--")


def _html(bundle: Bundle, title: str, settings: Mapping[str, Any], parts: Sequence[str], policy: str) -> str:
    meta = f'<meta http-equiv="Content-Security-Policy" content="{escape(policy)}">' if policy else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'{meta}<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="referrer" content="no-referrer"><link rel="icon" href="data:,">'
        f"<title>{escape(title)}</title><style>{bundle.style}</style></head><body>"
        '<noscript>This page draws a scene and needs JavaScript.</noscript><div id="app"></div>'
        f'<script type="application/json" id="settings">{json_in_script(settings)}</script>'
        f"{''.join(parts)}<script>{_script(bundle)}</script></body></html>\n"
    )
