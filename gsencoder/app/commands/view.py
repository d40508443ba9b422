"""`gsencoder view FEATURES`: a page over a scene and its features, served while it is looked at, or as one file."""

import sys
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from gsencoder.app.output import check_output_files, sole_writer
from gsencoder.app.progress import console
from gsencoder.app.scenes import WordsOptions, queried_scene
from gsencoder.app.summary import Summary, write_beside
from gsencoder.core.errors import InputError, printable
from gsencoder.core.files import atomic_file
from gsencoder.core.process import accept_stop
from gsencoder.core.settings import option
from gsencoder.data.scenes import DistinctPaths, SceneConfig, load_scene
from gsencoder.data.up import with_up
from gsencoder.fusion.folder import load_features
from gsencoder.infer.localize import LocalizeConfig, select_features
from gsencoder.infer.page.page import Bundle, FileOptions, fitting_page, load_bundle, scene_container, served_page
from gsencoder.infer.page.search import SceneSearch, drawn_scene
from gsencoder.infer.page.server import ViewServer
from gsencoder.infer.views.photographs import with_photographs
from gsencoder.text.vocabulary import TableTextConfig, TextConfig, Words
from gsencoder.types import Scene, SceneObject
from gsencoder.types.orientation import upright_scene

SUFFIX = ".html"


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewConfig(WordsOptions):
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
        1_000_000, "of more Gaussians so many are drawn and searched, evenly chosen and enlarged"
    )
    port: int = option(0, "of the server; 0 = any that is free")
    host: str = option("127.0.0.1", "address that the server listens on; others than 127.0.0.1 open it to a network")
    open: bool | None = option(None, "open a browser; empty = if standard output is a terminal")
    megabytes: float = option(
        25.0, "largest size of out=; spherical harmonics, then Gaussians are left out, and the page says so"
    )
    error: float = option(0.01, "largest mean loss of centered cosine of the quantized features in out=")
    photographs: int = option(24, "largest number of photographs in out=")
    data: SceneConfig = field(default_factory=SceneConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    text: TextConfig = field(default_factory=TableTextConfig)

    def __post_init__(self) -> None:
        if len(self.paths) > 2:
            raise InputError(f"paths: expected one or two folders of features, got {len(self.paths)}")
        if self.max_gaussians < 1:
            raise InputError(f"max_gaussians: expected 1 or more, got {self.max_gaussians}")
        if not 0 <= self.port < 1 << 16:
            raise InputError(f"port: expected 0 to 65535, got {self.port}")
        if self.host in ("", "0.0.0.0", "::"):
            raise InputError(
                f"host: expected one address, such as 127.0.0.1 or that of a network, got {self.host!r}; requests for "
                "other addresses are refused"
            )
        if not 0 < self.megabytes < 2000:
            raise InputError(f"megabytes: expected a size above 0, got {self.megabytes}")
        if not 0 < self.error < 1:
            raise InputError(f"error: expected a budget between 0 and 1, got {self.error}")
        if self.photographs < 0:
            raise InputError(f"photographs: expected 0 or more, got {self.photographs}")
        if self.localize.contrast or self.localize.mode != "centered":
            raise InputError("localize.contrast, localize.mode: the page compares centered cosines; leave them out")
        if self.out is not None and self.out.suffix.lower() != SUFFIX:
            raise InputError(f"out: expected a file that ends in {SUFFIX}, got {self.out.name}")


def run(config: ViewConfig, summary: Summary) -> None:
    """Serves the page until it is interrupted, or writes it."""
    DistinctPaths().add(map(Path, config.paths))
    bundle = load_bundle()
    if config.out is not None:
        check_output_files((config.out, Path(f"{config.out}.summary.json")), config.overwrite)
    with summary.step("load"):
        photographed = load_scene(config.photos, options=config.data) if config.photos else None
        loaded = [_load(Path(path), config, photographed) for path in config.paths]
    names = [scene.name for scene, _ in loaded]
    if len(set(names)) > 1:
        raise InputError(
            f"paths: {config.paths[0]} is of scene {names[0]}, and {config.paths[1]} of {names[1]}; give two folders "
            "of one scene, which are shown under one camera"
        )
    objects = () if photographed is None else photographed.objects
    titles = _titles([Path(path) for path in config.paths])
    if config.out is not None:
        _write(config.out, config, bundle, loaded, titles, objects, summary)
    else:
        _serve(config, bundle, loaded, titles, objects)


def _load(folder: Path, config: ViewConfig, photographed: Scene | None) -> tuple[Scene, Words | None]:
    scene, _ = with_up(load_features(folder))
    scene = upright_scene(scene if photographed is None else with_photographs(scene, photographed))
    if not (config.head or config.words) and isinstance(config.text, TableTextConfig):
        _, features = select_features(scene, config.space or None)
        if not features.space.text_encoder:
            # Features such as DINOv2's can be looked at.
            return replace(scene, features={features.space.name: features}), None
    return queried_scene(scene, folder, head=config.head, space=config.space, words_file=config.words, text=config.text)


def _titles(folders: Sequence[Path]) -> list[str]:
    """What tells two folders apart: their names, or their paths where the names are the same."""
    names = [folder.resolve().name for folder in folders]
    return names if len(set(names)) == len(names) else [str(folder) for folder in folders]


def _serve(
    config: ViewConfig,
    bundle: Bundle,
    loaded: Sequence[tuple[Scene, Words | None]],
    titles: Sequence[str],
    objects: tuple[SceneObject, ...],
) -> None:
    searches = [
        SceneSearch(
            shown=drawn_scene(scene, title, max_gaussians=config.max_gaussians), words=words, config=config.localize
        )
        for (scene, words), title in zip(loaded, titles, strict=True)
    ]
    name = loaded[0][0].name
    settings = {"kind": "server", "scenes": len(searches), "notes": []}
    page = served_page(bundle, f"{name} · gsencoder view", settings)
    scenes = [scene_container(search, objects) for search in searches]
    with ViewServer(page, searches, scenes, host=config.host, port=config.port) as server:
        # The address is the result: it is printed also where there is no terminal, at once.
        print(f"{server.address} shows {printable(name)}; Ctrl-C ends it", flush=True)
        if config.open or (config.open is None and sys.stdout.isatty()):
            webbrowser.open(server.address)
        try:
            server.serve_forever(poll_interval=0.1)
        except KeyboardInterrupt:
            accept_stop()
            console(config.quiet).print("ended")


def _write(
    out: Path,
    config: ViewConfig,
    bundle: Bundle,
    loaded: Sequence[tuple[Scene, Words | None]],
    titles: Sequence[str],
    objects: tuple[SceneObject, ...],
    summary: Summary,
) -> None:
    options = FileOptions(error=config.error, sh_degree=3, photographs=config.photographs, photograph_side=640)
    with summary.step("page"):
        page = fitting_page(
            bundle,
            [(scene, title, words) for (scene, words), title in zip(loaded, titles, strict=True)],
            config.localize,
            objects,
            options,
            max_gaussians=config.max_gaussians,
            max_bytes=int(config.megabytes * 1e6),
        )
    with sole_writer(out, overwrite=config.overwrite):
        with summary.step("write"), atomic_file(out) as stream:
            stream.write(page.page)
        summary.results.update(
            page=str(out),
            bytes=len(page.page),
            gaussians=page.gaussians,
            sh_degree=page.sh_degree,
            photographs=page.photographs,
            feature_error=page.feature_error,
            left_out=list(page.notes),
        )
        write_beside(out, summary)
    screen = console(config.quiet)
    for note in page.notes:
        screen.print(note)
    counts = " and ".join(f"{count:,}" for count in page.gaussians)
    screen.print(
        f"{out}: {len(page.page) / 1e6:.1f} MB; {counts} Gaussians, spherical harmonics of degree "
        f"{max(page.sh_degree)}; opens in a browser without a network"
    )
