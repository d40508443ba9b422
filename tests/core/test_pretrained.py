"""Models of folders: what is said of those that cannot be read, and the fingerprint of those that can."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gsencoder.core import pretrained
from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import digest_files, load_pretrained, read_config


def reason(call: Callable[[], Any]) -> str:
    """What a call complains of, in one line."""
    with pytest.raises((OSError, ValueError)) as error:
        call()
    return " ".join(str(error.value).split())


def test_the_first_160_characters_of_what_the_library_says_are_passed_on(tmp_path: Path) -> None:
    import transformers

    def open_config() -> Any:
        return transformers.AutoConfig.from_pretrained(str(tmp_path), local_files_only=True)

    class Loader:
        @staticmethod
        def from_pretrained(*_: Any, **__: Any) -> Any:
            return open_config()

    (tmp_path / "config.json").write_text('{"model_type": "mystery"}')
    (tmp_path / "model.safetensors").touch()
    said = reason(open_config)
    assert len(said) > 160
    for call in (lambda: read_config(tmp_path, "a test"), lambda: load_pretrained(Loader, tmp_path, "a test")):
        with pytest.raises(InputError) as error:
            call()
        assert str(error.value) == f"a test: {tmp_path} holds no model that transformers reads: {said[:160]}"


def test_the_fingerprint_is_that_of_settings_and_files_in_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    first.write_bytes(b"0123456789")
    second.write_bytes(b"abc")
    monkeypatch.setattr(pretrained, "BLOCK_BYTES", 4)
    assert digest_files(first, second) == hashlib.sha256(b"0123456789abc").hexdigest()[:16]
    assert digest_files(second, first) == hashlib.sha256(b"abc0123456789").hexdigest()[:16]
    assert digest_files(first, settings=("é", 1)) == hashlib.sha256("('é', 1)0123456789".encode()).hexdigest()[:16]
