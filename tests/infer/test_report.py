"""The HTML report: one well-formed file that loads nothing and believes nobody's text."""

import base64
import io
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from gsencoder.core.errors import InputError
from gsencoder.infer.page.report import HtmlReport

VOID = {"meta", "img", "br"}


class Outline(HTMLParser):
    """Collects tags and text, and checks that every tag is closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text += data


def parse(report: HtmlReport) -> Outline:
    outline = Outline()
    outline.feed(report.html())
    outline.close()
    assert outline.open == []
    return outline


def full_report() -> HtmlReport:
    report = HtmlReport("Demo", "What happened")
    report.facts({"Gaussians": 123456, "rank": 12, "energy": 0.98765, "unit": None, "whole": True})
    report.section("Views", "Two of them.")
    report.pictures([np.zeros((4, 6, 3), np.uint8), np.full((5, 5, 3), 200, np.uint8)], ["dark", "bright"])
    report.section("Boxes")
    report.table(["word", "score"], [["mug", 0.912345], ["chair", 0.5]])
    report.section("Timings")
    report.timings({"fuse": 3.0, "localize": 1.0})
    return report


def test_a_report_shows_everything_that_was_put_in() -> None:
    outline = parse(full_report())
    for text in ("Demo", "123,456", "0.9877", "none", "yes", "Two of them.", "dark", "mug", "0.9123", "4.00 s"):
        assert text in outline.text
    widths = [attrs["style"] for tag, attrs in outline.tags if tag == "span"]
    assert widths == ["width: 100.0%", "width: 33.3%"]


def test_pictures_are_inside_the_file_and_are_what_was_given() -> None:
    report = HtmlReport("x")
    picture = np.random.default_rng(0).integers(0, 256, (7, 9, 3), np.uint8)
    report.pictures([picture], ["noise"], lossless=True)
    source = next(attrs["src"] for tag, attrs in parse(report).tags if tag == "img")
    kind, data = source.split(",")
    assert kind == "data:image/png;base64"
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))), picture)


def test_nothing_is_loaded_and_nothing_runs() -> None:
    html = full_report().html()
    assert not re.search(r"<(script|link|iframe|object)|\son\w+=|https?:|@import|url\(", html)


@given(st.text(max_size=60))
@settings(deadline=None, max_examples=60)
def test_any_text_is_escaped_everywhere(text: str) -> None:
    hostile = f"\"><script>{text}</script>&<b>'"
    report = HtmlReport(hostile, hostile)
    report.facts({hostile: hostile})
    report.section(hostile, hostile)
    report.table([hostile], [[hostile]])
    report.timings({hostile: 1.0})
    report.pictures([np.zeros((1, 1, 3), np.uint8)], [hostile])
    report.section("b")
    report.section("c")
    tags = {tag for tag, _ in parse(report).tags}
    assert "script" not in tags
    assert "b" not in tags


def test_a_written_report_is_utf8_and_survives_a_lone_surrogate(tmp_path: Path) -> None:
    report = HtmlReport("naïve 猫 \udcff")
    report.write(tmp_path / "report.html")
    assert "naïve 猫 ?" in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_rows_and_captions_must_fit() -> None:
    report = HtmlReport("x")
    with pytest.raises(InputError, match="row 1 has 1 cells, expected 2"):
        report.table(["a", "b"], [[1, 2], [3]])
    with pytest.raises(InputError, match="1 pictures but 0 captions"):
        report.pictures([np.zeros((1, 1, 3), np.uint8)], [])
