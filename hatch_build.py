"""Builds the page of `gsencoder view` when a wheel or an sdist is built; see viewer/build.py.

An sdist holds the built page, so that a wheel of it needs no node. Editable installations leave it to `make viewer`.
"""

import importlib.util
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ViewerBuildHook(BuildHookInterface):
    """Hatchling calls `initialize` before it collects files."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002
        if version == "editable":
            return
        path = Path(self.root) / "viewer" / "build.py"
        spec = importlib.util.spec_from_file_location("viewer_build", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        if not module.is_built():
            module.build()
