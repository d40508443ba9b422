"""`gsencoder demo` writes its room as a page as well, where the page's script was built."""

from pathlib import Path

import pytest

from gsencoder.app import main as cli
from gsencoder.core.errors import InputError
from gsencoder.infer.page.page import Bundle

SMALL = ("demo", "objects=2", "views=2", "width=64")


def test_the_report_links_to_the_page_where_there_is_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def built() -> Bundle:
        return Bundle(script="/* the script */", style="")

    def unbuilt() -> Bundle:
        raise InputError("view: the page's script is missing")

    for name, load in (("with", built), ("without", unbuilt)):
        monkeypatch.setattr("gsencoder.app.commands.demo.load_bundle", load)
        assert cli.main([*SMALL, f"out={tmp_path / name}"]) == 0
        output = capsys.readouterr().out
        assert (tmp_path / name / "page.html").is_file() == (load is built)
        assert ('<a href="page.html">' in (tmp_path / name / "report.html").read_text()) == (load is built)
        assert ("page.html is left out: view: the page's script is missing" in " ".join(output.split())) == (
            load is unbuilt
        )
