"""Settings of a server, and a question to it."""

from typing import Any

import numpy as np

from gsencoder.infer.ask.ask import messages
from gsencoder.infer.ask.server import VlmConfig, VlmServer, request_body

KEY = "sk-1234567890"


def config(url: str, **changed: Any) -> VlmConfig:
    return VlmConfig(**{"base_url": url, "model": "tiny", "key": KEY, "retries": 0, "timeout": 5.0} | changed)


def ask(url: str, **changed: Any) -> Any:
    chosen = config(url, **changed)
    picture = np.zeros((8, 8, 3), np.uint8)
    return VlmServer(chosen).ask(request_body(messages("what?", [picture], side=64, kind="png"), chosen))
