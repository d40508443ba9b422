"""A page that is one file, within a number of bytes: what is left out for it is said on the page."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from gsencoder.core.errors import InputError
from gsencoder.infer.localize.localize import LocalizeConfig, select_features
from gsencoder.infer.viewer.bundle import Bundle
from gsencoder.infer.viewer.container import Container
from gsencoder.infer.viewer.page import file_page
from gsencoder.infer.viewer.page_scene import FileOptions, file_container
from gsencoder.infer.viewer.search import SceneSearch
from gsencoder.infer.viewer.shown import drawn_scene
from gsencoder.text.vocabulary import OpenVocabulary, Words, closed_table
from gsencoder.types import Scene, SceneObject

FEWEST_GAUSSIANS = 1000
"""A page with fewer shows nothing that can be recognized."""
THINNING = 0.9
"""Of the Gaussians that should fit by proportion, so many are taken."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MadePage:
    """A page and what became of the scenes in it.

    Attributes:
        page: the file.
        gaussians: in each scene.
        sh_degree: of each scene.
        photographs: in each scene.
        feature_error: what quantization cost, 1 − mean centered cosine, of each scene.
        notes: what was left out, a sentence each.
    """

    page: bytes
    gaussians: tuple[int, ...]
    sh_degree: tuple[int, ...]
    photographs: tuple[int, ...]
    feature_error: tuple[float, ...]
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
) -> MadePage:
    """The page with as much as fits: spherical harmonics are left out degree by degree, then Gaussians.

    Args:
        bundle: script and style.
        scenes: each with its title and words.
        config: how words become boxes.
        objects: labeled ones, which may be none.
        options: what the file holds at most.
        max_gaussians: in each scene.
        max_bytes: of the file.

    Raises:
        InputError: not even a thousand Gaussians fit, or what `file_container` raises.
    """
    highest = max(_degree(scene) for scene, _, _ in scenes)
    largest = max(len(select_features(scene, None)[0]) for scene, _, _ in scenes)
    limit, degree = max_gaussians, min(options.sh_degree, highest)
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
        containers = [
            _container(scene, title, words, config, objects, replace(options, sh_degree=degree), limit)
            for scene, title, words in scenes
        ]
        settings = {"kind": "file", "scenes": len(containers), "notes": notes}
        page = file_page(bundle, f"{scenes[0][0].name} · gsencoder view", settings, containers)
        if len(page) <= max_bytes:
            break
        if degree > 0:
            degree -= 1
            continue
        fixed = len(file_page(bundle, "", settings, []))
        limit = int(THINNING * min(limit, largest) * max(0.0, max_bytes - fixed) / (len(page) - fixed))
        if limit < FEWEST_GAUSSIANS:
            raise InputError(
                f"megabytes={max_bytes / 1e6:g}: not even {FEWEST_GAUSSIANS:,} Gaussians fit beside the page itself, "
                f"which takes {fixed / 1e6:.1f} MB; give megabytes= a larger number"
                + (", or photographs=0" if any(each.meta["photographViews"] for each in containers) else "")
            )
    metas = [each.meta for each in containers]
    return MadePage(
        page=page,
        gaussians=tuple(meta["count"] for meta in metas),
        sh_degree=tuple(meta["shDegree"] for meta in metas),
        photographs=tuple(len(meta["photographViews"]) for meta in metas),
        feature_error=tuple(meta["featureError"] for meta in metas),
        notes=(*notes, *(note for meta in metas for note in meta["notes"])),
    )


def _degree(scene: Scene) -> int:
    return 0 if scene.gaussians is None else scene.gaussians.sh_degree


def _container(
    scene: Scene,
    title: str,
    words: Words | None,
    config: LocalizeConfig,
    objects: tuple[SceneObject, ...],
    options: FileOptions,
    limit: int,
) -> Container:
    advice = "megabytes= or max_gaussians= takes more"
    search = SceneSearch(
        shown=drawn_scene(scene, title, max_gaussians=limit, advice=advice), words=words, config=config
    )
    return file_container(search, objects, options)
