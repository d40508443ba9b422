"""`gsencoder view FEATURES`: a page over a scene and its features, served while it is looked at, or as one file."""

import sys
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from gsencoder.app.options import FeaturesConfig
from gsencoder.app.run import Run
from gsencoder.app.scenes import load_query
from gsencoder.core.errors import InputError, printable
from gsencoder.core.files import write_bytes
from gsencoder.core.settings import option
from gsencoder.data.scenes import SceneConfig, distinct_paths, load_scene
from gsencoder.data.up import with_up
from gsencoder.fusion.folder import load_features
from gsencoder.infer.localize import LocalizeConfig, select_features
from gsencoder.infer.page.page import Bundle, FileOptions, fitting_page, load_bundle, scene_container, served_page
from gsencoder.infer.page.search import SceneSearch, thin_for_display
from gsencoder.infer.page.server import ViewServer
from gsencoder.infer.views.photographs import with_photographs
from gsencoder.text.vocabulary import TableTextConfig, TextConfig, Words
from gsencoder.types import Scene, SceneObject
from gsencoder.types.orientation import upright_scene

SUFFIX = ".html"
FEATURE_ERROR = 0.01
"""Largest mean loss of centered cosine of the quantized features in a file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewConfig(FeaturesConfig):
    """Settings of `view`."""

    paths: tuple[str, ...] = option(
        (),
        "a folder written by fuse, encode, pack or memory; two folders of one scene are shown side by side",
        metavar="FEATURES",
        required=True,
    )
    out: Path | None = option(
        None,
        "an .html file that holds page and scene, and opens without a server; empty = serve the page",
        metavar="FILE",
    )
    photos: str = option("", "the scene that was fused; its photographs and labeled objects are shown")
    max_gaussians: int = option(
        1_000_000, "of more Gaussians this number is drawn and searched, evenly chosen and enlarged", ge=1
    )
    port: int = option(0, "of the server; 0 = any that is free", ge=0, lt=1 << 16)
    open: bool | None = option(None, "open a browser; empty = if standard output is a terminal")
    megabytes: float = option(
        25.0,
        "largest size of out=; spherical harmonics, then Gaussians are left out, and the page says so",
        gt=0,
        lt=2000,
    )
    photographs: int = option(24, "largest number of photographs in out=", ge=0)
    data: SceneConfig = field(default_factory=SceneConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    text: TextConfig = field(default_factory=TableTextConfig)

    def __post_init__(self) -> None:
        FeaturesConfig.__post_init__(self)
        if len(self.paths) > 2:
            raise InputError(f"paths: expected one or two folders of features, got {len(self.paths)}")
        if self.localize.contrast or self.localize.mode != "centered":
            raise InputError("localize.contrast, localize.mode: the page compares centered cosines; leave them out")
        if self.out is not None and self.out.suffix.lower() != SUFFIX:
            raise InputError(f"out: expected a file that ends in {SUFFIX}, got {self.out.name}")


def run(config: ViewConfig, run: Run) -> None:
    """Serves the page until it is interrupted, or writes it."""
    distinct_paths(map(Path, config.paths))
    bundle = load_bundle()
    if config.out is not None:
        run.check_files(config.out)
    with run.step("load"):
        photographed = load_scene(config.photos, options=config.data) if config.photos else None
        loaded = [_load(Path(path), config, photographed) for path in config.paths]
    names = [scene.name for scene, _ in loaded]
    if len(set(names)) > 1:
        raise InputError(
            f"paths: {config.paths[0]} is of scene {names[0]}, and {config.paths[1]} of {names[1]}; give two folders "
            "of one scene, which are shown under one camera"
        )
    objects = () if photographed is None else photographed.objects
    titles = [Path(path).resolve().name for path in config.paths]
    if len(set(titles)) < len(titles):
        titles = list(config.paths)
    if config.out is not None:
        _write(config.out, config, bundle, loaded, titles, objects, run)
    else:
        _serve(config, bundle, loaded, titles, objects, run)


def _load(folder: Path, config: ViewConfig, photographed: Scene | None) -> tuple[Scene, Words | None]:
    scene, _ = with_up(load_features(folder))
    scene = upright_scene(scene if photographed is None else with_photographs(scene, photographed))
    if not (config.head or config.words) and isinstance(config.text, TableTextConfig):
        _, features = select_features(scene, config.space or None)
        if not features.space.text_encoder:
            # Features such as DINOv2's can be looked at.
            return replace(scene, features={features.space.name: features}), None
    return load_query(scene, folder, head=config.head, space=config.space, words_file=config.words, text=config.text)


def _serve(
    config: ViewConfig,
    bundle: Bundle,
    loaded: Sequence[tuple[Scene, Words | None]],
    titles: Sequence[str],
    objects: tuple[SceneObject, ...],
    run: Run,
) -> None:
    searches = [
        SceneSearch(
            display=thin_for_display(scene, title, max_gaussians=config.max_gaussians),
            words=words,
            config=config.localize,
        )
        for (scene, words), title in zip(loaded, titles, strict=True)
    ]
    name = loaded[0][0].name
    settings = {"kind": "server", "scenes": len(searches), "notes": []}
    page = served_page(bundle, f"{name} · gsencoder view", settings)
    scenes = [scene_container(search, objects) for search in searches]
    with ViewServer(page, searches, scenes, port=config.port) as server:
        # The address is the result: it is printed also where there is no terminal, at once.
        print(f"{server.address} shows {printable(name)}; Ctrl-C ends it", flush=True)
        if config.open or (config.open is None and sys.stdout.isatty()):
            webbrowser.open(server.address)
        try:
            server.serve_forever(poll_interval=0.1)
        except KeyboardInterrupt:
            run.print("ended")


def _write(
    out: Path,
    config: ViewConfig,
    bundle: Bundle,
    loaded: Sequence[tuple[Scene, Words | None]],
    titles: Sequence[str],
    objects: tuple[SceneObject, ...],
    run: Run,
) -> None:
    options = FileOptions(error=FEATURE_ERROR, sh_degree=3, photographs=config.photographs, photograph_side=640)
    with run.step("page"):
        page = fitting_page(
            bundle,
            [(scene, title, words) for (scene, words), title in zip(loaded, titles, strict=True)],
            config.localize,
            objects,
            options,
            max_gaussians=config.max_gaussians,
            max_bytes=int(config.megabytes * 1e6),
            track=run.track,
        )
    run.results.update(
        page=str(out),
        bytes=len(page.page),
        gaussians=[meta["count"] for meta in page.metas],
        sh_degree=[meta["shDegree"] for meta in page.metas],
        photographs=[len(meta["photographViews"]) for meta in page.metas],
        feature_error=[meta["featureError"] for meta in page.metas],
        left_out=list(page.notes),
    )
    with run.file(out), run.step("write"):
        write_bytes(out, page.page)
    run.print(*page.notes)
    counts = " and ".join(f"{meta['count']:,}" for meta in page.metas)
    run.print(
        f"{out}: {len(page.page) / 1e6:.1f} MB; {counts} Gaussians, spherical harmonics of degree "
        f"{max(run.results['sh_degree'])}; opens in a browser without a network"
    )
