"""Self-contained HTML reports of text, tables and pictures."""

import base64
import io
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from gsencoder.core.errors import InputError
from gsencoder.core.files import atomic_file

_STYLE = """
:root { color-scheme: light dark; --paper: #fcfcfa; --ink: #1d2026; --faint: #666c76; --line: #dfe1e4; --card: #ffffff;
  --accent: #2158a8; }
@media (prefers-color-scheme: dark) { :root { --paper: #15171b; --ink: #e6e7ea; --faint: #9aa1ac; --line: #30343b;
  --card: #1c1f24; --accent: #8ab4f4; } }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: var(--paper); color: var(--ink); overflow-wrap: break-word;
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 72rem; margin: 0 auto; padding: 2.5rem 1.25rem 4rem; }
h1 { font-size: clamp(1.6rem, 4vw, 2.3rem); line-height: 1.2; letter-spacing: -0.015em; margin: 0 0 .4rem; }
h2 { font-size: 1.3rem; line-height: 1.3; margin: 2.8rem 0 .6rem; padding-top: 1rem;
  border-top: 1px solid var(--line); }
p { margin: .5rem 0; max-width: 44rem; }
.lead { color: var(--faint); font-size: 1.08rem; }
nav { margin: 1rem 0 0; font-size: .92rem; } nav a { margin-right: 1.1rem; white-space: nowrap; color: var(--accent); }
.facts { display: grid; grid-template-columns: repeat(auto-fill, minmax(9.5rem, 1fr)); gap: .7rem; margin: 1.6rem 0 0; }
.facts div { background: var(--card); border: 1px solid var(--line); border-radius: .55rem; padding: .6rem .8rem; }
.facts dt { color: var(--faint); font-size: .82rem; }
.facts dd { margin: 0; font-size: 1.12rem; font-weight: 600; font-variant-numeric: tabular-nums; }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, var(--cell)), 1fr)); gap: 1rem; }
figure { margin: 0; } figure img { display: block; width: 100%; height: auto; border-radius: .4rem; background: #888; }
figcaption { color: var(--faint); font-size: .88rem; line-height: 1.4; padding: .35rem .1rem 0; }
.scroll { overflow-x: auto; margin: .8rem 0; }
table { border-collapse: collapse; font-size: .93rem; min-width: 20rem; }
th, td { text-align: left; padding: .38rem .9rem .38rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { color: var(--faint); font-weight: 600; font-size: .84rem; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
td.bar { width: 40%; min-width: 6rem; }
td.bar span { display: block; height: .62rem; margin-top: .45rem; border-radius: .2rem; background: var(--accent); }
footer { margin-top: 3rem; color: var(--faint); font-size: .85rem; }
@media print { h2 { break-after: avoid; } figure, tr { break-inside: avoid; } }
"""


class HtmlReport:
    """Collects sections and writes them as one file. All text is escaped; numbers are aligned by their type."""

    def __init__(self, title: str, lead: str = "") -> None:
        self.title, self.lead = title, lead
        self._facts: dict[str, str] = {}
        self._sections: list[tuple[str, list[str]]] = []

    def facts(self, facts: Mapping[str, object]) -> None:
        """The figures that a reader wants first, shown as tiles under the title."""
        self._facts |= {name: _text(value) for name, value in facts.items()}

    def section(self, heading: str, text: str = "") -> None:
        """Starts a section; what is added next belongs to it."""
        self._sections.append((heading, []))
        if text:
            self.paragraph(text)

    def paragraph(self, text: str) -> None:
        """Adds a paragraph."""
        self._add(f"<p>{escape(text)}</p>")

    def link(self, text: str, file: str) -> None:
        """Adds a link to a file next to the page."""
        self._add(f'<p><a href="{escape(quote(file))}">{escape(text)}</a></p>')

    def pictures(
        self,
        pictures: Sequence[UInt8[np.ndarray, "_h _w 3"]],
        captions: Sequence[str],
        *,
        cell: int = 320,
        lossless: bool = False,
    ) -> None:
        """Adds a grid of pictures, as many in a row as fit.

        Args:
            pictures: uint8 RGB.
            cell: smallest width of a picture on the page, in CSS pixels.
            lossless: PNG, not JPEG: for plots and flat colors.
        """
        if len(pictures) != len(captions):
            raise InputError(f"HtmlReport.pictures: {len(pictures)} pictures but {len(captions)} captions")
        figures = [
            f'<figure><img alt="{escape(caption)}" width="{picture.shape[1]}" height="{picture.shape[0]}" '
            f'src="{_data_url(picture, lossless)}"><figcaption>{escape(caption)}</figcaption></figure>'
            for picture, caption in zip(pictures, captions, strict=True)
        ]
        self._add(f'<div class="grid" style="--cell: {int(cell)}px">{"".join(figures)}</div>')

    def table(self, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        """Adds a table; columns of numbers align to the right. It scrolls sideways on narrow screens."""
        bad = [index for index, row in enumerate(rows) if len(row) != len(columns)]
        if bad:
            raise InputError(f"HtmlReport.table: row {bad[0]} has {len(rows[bad[0]])} cells, expected {len(columns)}")
        kinds = [
            ' class="number"' if rows and all(_is_number(row[index]) for row in rows) else ""
            for index in range(len(columns))
        ]
        head = "".join(f"<th{kind}>{escape(name)}</th>" for name, kind in zip(columns, kinds, strict=True))
        body = "".join(
            "<tr>"
            + "".join(f"<td{kind}>{escape(_text(value))}</td>" for value, kind in zip(row, kinds, strict=True))
            + "</tr>"
            for row in rows
        )
        self._add(f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>')

    def timings(self, seconds: Mapping[str, float]) -> None:
        """Adds a table of steps with their seconds and a bar each, and the sum."""
        total = sum(seconds.values())
        longest = max(seconds.values(), default=0.0) or 1.0
        rows = "".join(
            f'<tr><td>{escape(step)}</td><td class="number">{value:.2f} s</td>'
            f'<td class="bar"><span style="width: {max(0.0, min(100.0, 100 * value / longest)):.1f}%"></span></td></tr>'
            for step, value in seconds.items()
        )
        rows += f'<tr><th>together</th><th class="number">{total:.2f} s</th><td></td></tr>'
        self._add(f'<div class="scroll"><table><tbody>{rows}</tbody></table></div>')

    def html(self) -> str:
        """The page."""
        facts = "".join(
            f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in self._facts.items()
        )
        headed = [(index, heading) for index, (heading, _) in enumerate(self._sections) if heading]
        links = "".join(f'<a href="#s{index}">{escape(heading)}</a>' for index, heading in headed)
        sections = "".join(
            f'<section id="s{index}">{f"<h2>{escape(heading)}</h2>" if heading else ""}{"".join(parts)}</section>'
            for index, (heading, parts) in enumerate(self._sections)
        )
        return (
            '<!doctype html><html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{escape(self.title)}</title><style>{_STYLE}</style></head><body><main>"
            f"<header><h1>{escape(self.title)}</h1>"
            + (f'<p class="lead">{escape(self.lead)}</p>' if self.lead else "")
            + (f'<dl class="facts">{facts}</dl>' if facts else "")
            + (f"<nav>{links}</nav>" if len(headed) > 2 else "")
            + f"</header>{sections}</main></body></html>\n"
        )

    def write(self, path: str | Path) -> None:
        """Writes the page, whole or not at all."""
        with atomic_file(path) as stream:
            # Lone surrogates, which a hostile file name can hold, have no UTF-8.
            stream.write(self.html().encode("utf-8", "replace"))

    def _add(self, part: str) -> None:
        if not self._sections:
            self.section("")
        self._sections[-1][1].append(part)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def _text(value: object) -> str:
    """A value for people: thousands separated, four significant digits."""
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    if isinstance(value, (int, np.integer)):
        return f"{int(value):,}"
    if isinstance(value, (float, np.floating)):
        number = float(value)
        return f"{number:,.0f}" if 1e4 <= abs(number) < 1e15 else f"{number:.4g}"
    return "none" if value is None else str(value)


def _data_url(picture: UInt8[np.ndarray, "H W 3"], lossless: bool) -> str:
    buffer = io.BytesIO()
    image = Image.fromarray(np.ascontiguousarray(picture))
    if lossless:
        image.save(buffer, "PNG", optimize=True)
    else:
        image.save(buffer, "JPEG", quality=88, subsampling=0, optimize=True)
    kind = "png" if lossless else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
