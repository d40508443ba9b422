"""Command lines that Hydra composes once in a process of tests."""

import re
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ENCODED = re.compile(r"\$\{text:(x[0-9a-f]*)\}")


class Once:
    """Hydra, which composes each form of a command line once in a process of tests, since that takes 0.1 to 0.2 s.

    Lines of one form differ in their text alone (paths, words), which is put in when the settings are resolved. What
    Hydra refuses is not stored: it is composed as it was written, so that its errors are those that users see.
    """

    composed: dict[Hashable, Any] = {}  # noqa: RUF012

    def __init__(self, open_hydra: Any, command: str, cls: type) -> None:
        self._arguments = open_hydra, command, cls
        self._opened: Any = None

    def __getattr__(self, name: str) -> Any:
        """Anything else is Hydra's, which is opened then."""
        if self._opened is None:
            open_hydra, command, cls = self._arguments
            self._opened = open_hydra(command, cls, None)
            self._hydra = self._opened.__enter__()
        return getattr(self._hydra, name)

    def close(self) -> None:
        if self._opened is not None:
            self._opened.__exit__(None, None, None)

    def compose_config(self, command: str, written: Sequence[str], mode: Any, *, from_shell: bool) -> Any:
        from omegaconf import OmegaConf

        from gsencoder.app.compose import decode_text

        texts: list[str] = []

        def numbered(match: re.Match[str]) -> str:
            texts.append(decode_text(match[1]))
            return f"${{text_of_line:{len(texts) - 1}}}"

        form = [ENCODED.sub(numbered, word) for word in written]
        key = (self._arguments[2], command, *form)
        if key not in self.composed:
            compose = self.__getattr__("compose_config")
            try:
                self.composed[key] = compose(command, form, mode, from_shell=from_shell)
            except Exception:
                return compose(command, list(written), mode, from_shell=from_shell)
        OmegaConf.register_new_resolver("text_of_line", lambda number: texts[int(number)], replace=True)
        return self.composed[key]


def compose_once() -> None:
    """Lets `compose` take what was composed before, for the commands and the YAML files of the package."""
    from hydra.core.config_store import ConfigStore
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    from gsencoder.app import compose
    from gsencoder.core.errors import InputError

    open_hydra, store_settings = compose.open_hydra, compose.store_settings
    store = ConfigStore.instance()
    of_hydra = dict(store.repo)
    stored: list[tuple[str, type]] = []

    def store_unless_stored(command: str, cls: type) -> None:
        # Commands share names of groups, so that what another one stored is in the way; and Hydra copies all of the
        # store each time that it composes.
        if stored[-1:] != [(command, cls)]:
            store.repo = dict(of_hydra)
            store_settings(command, cls)
            stored[:] = [(command, cls)]

    @contextmanager
    def open_once(command: str, cls: type, conf: Path | None) -> Iterator[Any]:
        if conf is not None:
            with open_hydra(command, cls, conf) as hydra:
                yield hydra
            return
        once = Once(open_hydra, command, cls)
        try:
            yield once
        except (HydraException, OmegaConfBaseException) as error:
            raise InputError(" ".join(str(error).split())) from error
        finally:
            once.close()

    compose.open_hydra, compose.store_settings = open_once, store_unless_stored
