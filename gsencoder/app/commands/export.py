"""`gsencoder export weights=… out=FILE.onnx`: an encoder as one file that runs without torch."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsencoder.app.options import CommonConfig
from gsencoder.app.output import check_output_files, sole_writer
from gsencoder.app.progress import Progress, console
from gsencoder.app.summary import Summary, write_beside
from gsencoder.core.errors import InputError
from gsencoder.core.files import atomic_file
from gsencoder.core.process import Stored
from gsencoder.core.settings import option
from gsencoder.data.scenes import SceneConfig, find_scenes, load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.data.splats.files import READABLE
from gsencoder.fusion.folder import copy_heads, heads_beside, heads_of_graph, load_memories
from gsencoder.infer.encode import TorchEncoder
from gsencoder.infer.load import file_of_encoder
from gsencoder.infer.onnx.export import (
    COSINE,
    TOLERANCE,
    Cloud,
    check_cosines,
    check_parity,
    export_onnx,
    lower,
    random_cloud,
)
from gsencoder.infer.onnx.runtime import SUFFIX
from gsencoder.memory.attention import export_memory
from gsencoder.types import QueryMemory

MAX_SIZE = 10_000_000
"""Largest number of Gaussians of a random cloud; torch and the graph hold each in memory at once."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportConfig(CommonConfig):
    """Settings of `export`."""

    paths: tuple[str, ...] = option(
        (), "splats or scenes for the comparison, in addition to random clouds", metavar="SPLAT"
    )
    weights: str = option(
        "",
        "folder or file written by `train`, or the name of an encoder that comes with gsencoder; empty = "
        "house_cpu, which does",
    )
    memory: str = option(
        "", "folder written by `memory`, whose attention is exported, from queries to features, in place of an encoder"
    )
    space: str = option("", "teacher of the memory, if the folder holds several")
    out: Path | None = option(
        None,
        "the .onnx file; FILE.summary.json beside it holds the differences from torch",
        metavar="FILE",
        required=True,
    )
    precision: Stored = option(
        "float32",
        "what the graph computes in; int8_weights = stored in 8 bits, computed in float32; int8_dynamic = "
        "products of 8-bit integers, whose ranges are computed for each splat",
    )
    sizes: tuple[int, ...] = option(
        (1, 2, 31, 1000, 20000), "numbers of Gaussians of the random clouds for the comparison"
    )
    tolerance: float = option(
        TOLERANCE, "largest difference of the float32 graph from torch, as a share of the largest output"
    )
    cosine: float = option(
        COSINE,
        "smallest mean centered cosine of another precision's features to float32's, on each SPLAT, or on "
        "each random cloud where there is none",
    )
    splat: str = option("", f"Gaussians of scenes; empty = seeds. {READABLE}")
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)

    def __post_init__(self) -> None:
        if not self.sizes or min(self.sizes) < 1 or max(self.sizes) > MAX_SIZE:
            raise InputError(f"sizes: expected one or more numbers from 1 to {MAX_SIZE:,}, got {list(self.sizes)}")
        if not 0 < self.tolerance < 1:
            raise InputError(f"tolerance: expected a share between 0 and 1, got {self.tolerance}")
        if not -1 <= self.cosine <= 1:
            raise InputError(f"cosine: expected -1 to 1, got {self.cosine}")
        if self.memory and self.weights:
            raise InputError("memory, weights: expected one of the two, a memory or an encoder")
        if self.space and not self.memory:
            raise InputError("space: names a teacher of memory=; leave it out, or give memory=")
        if self.memory and self.paths:
            raise InputError("paths: splats are compared with encoders alone; leave them out with memory=")
        if self.memory and self.precision != "float32":
            raise InputError(f"precision: expected float32 with memory=, got {self.precision}")


def run(config: ExportConfig, summary: Summary) -> None:
    """Exports, compares with torch, and writes the file if it agrees."""
    assert config.out is not None
    if config.out.suffix.lower() != SUFFIX:
        raise InputError(f"out: expected a file that ends in {SUFFIX}, got {config.out.name}")
    if config.weights.lower().endswith(SUFFIX):
        raise InputError(f"weights: {config.weights} is an exported graph already; give the encoder that `train` wrote")
    files = (config.out, Path(f"{config.out}.summary.json"), heads_of_graph(config.out))
    check_output_files(files, config.overwrite)
    if config.memory:
        _export_memory(config, config.out, summary)
        return
    track = Progress(quiet=config.quiet)
    with summary.step("load"):
        encoder = TorchEncoder(config.weights)
        heads = heads_beside(file_of_encoder(config.weights))
        clouds = [Cloud(f"{size} random Gaussians", random_cloud(size, encoder.voxel)) for size in config.sizes]
        scenes = _scenes(config, encoder.voxel)
    screen = console(config.quiet)
    screen.print("translating the graph, which takes about a minute")
    with summary.step("export"):
        lowered = lower(encoder)
        exact = model = export_onnx(encoder, lowered)
    with summary.step("compare"):
        parity = check_parity(exact, encoder, [*clouds, *scenes], tolerance=config.tolerance, track=track)
    agreement = f"within {max(parity.values()):.1g} of torch's largest output"
    cosines: dict[str, float] = {}
    if config.precision != "float32":
        with summary.step("convert"):
            if config.precision == "float16":
                lowered = lower(encoder, half=True)
            model = export_onnx(encoder, lowered, config.precision)
        with summary.step("judge"):
            cosines = check_cosines(model, exact, scenes or clouds, cosine=config.cosine, track=track)
        agreement = (
            f"{config.precision}, {len(model) / len(exact):.2f} of float32's size, mean centered cosine to it "
            f"{min(cosines.values()):.4f} or more"
        )
    sizes = {cloud.name: len(cloud.gaussians) for cloud in (*clouds, *scenes)}
    compared = [sizes[name] for name in cosines or parity]
    summary.results.update(
        onnx=str(config.out),
        precision=config.precision,
        bytes=len(model),
        bytes_float32=len(exact),
        parity=parity,
        cosines=cosines,
        gaussians=sizes,
        **space_figures(encoder),
    )
    with sole_writer(config.out, overwrite=config.overwrite):
        with summary.step("write"), atomic_file(config.out) as stream:
            stream.write(model)
        write_beside(config.out, summary)
        if heads is None:
            # Those of a file that was replaced.
            heads_of_graph(config.out).unlink(missing_ok=True)
        else:
            copy_heads(heads, heads_of_graph(config.out), list(encoder.spaces.values()))
    if heads is not None:
        screen.print(f"{heads_of_graph(config.out)}: the adapter heads that take its features; keep it beside the file")
    screen.print(
        f"{config.out}: {len(model) / 1e6:.1f} MB; {agreement} on {len(compared)} clouds of {min(compared):,} to "
        f"{max(compared):,} Gaussians"
    )


def _export_memory(config: ExportConfig, out: Path, summary: Summary) -> None:
    """Writes the attention of a memory."""
    with summary.step("load"):
        memories = load_memories(config.memory)
        memory = _memory_of(memories, config.space)
    with summary.step("export"):
        model = export_memory(memory)
    summary.results.update(onnx=str(out), bytes=len(model), components=len(memory.bank), space=memory.space.describe())
    with sole_writer(out, overwrite=config.overwrite):
        with summary.step("write"), atomic_file(out) as stream:
            stream.write(model)
        write_beside(out, summary)
    console(config.quiet).print(
        f"{out}: {len(model) / 1e6:.1f} MB; features of {memory.space.channels} channels from queries of "
        f"{memory.channels}, by attention to {len(memory.bank):,} components"
    )


def _memory_of(memories: Mapping[str | None, QueryMemory], space: str) -> QueryMemory:
    """The memory of a teacher, by its name in the folder or that of its feature space."""
    if not space and len(memories) == 1:
        return next(iter(memories.values()))
    by_name = {name or memory.space.name: memory for name, memory in memories.items()}
    for memory in memories.values():
        by_name.setdefault(memory.space.name, memory)
    if space not in by_name:
        names = ", ".join(name or memory.space.name for name, memory in memories.items())
        hint = f"expected one of them, got {space!r}" if space else "name one of them"
        raise InputError(f"space: the folder has memories of {names}; {hint}")
    return by_name[space]


def space_figures(encoder: TorchEncoder) -> dict[str, Any]:
    """Channels, rank, words and space of an encoder; of each teacher by its name where there are several."""
    figures = {
        name: {
            "channels": outputs.space.channels,
            "rank": outputs.channels,
            "words": len(encoder.tables.get(name, ())),
            "space": outputs.space.describe(),
        }
        for name, outputs in encoder.outputs.by_teacher.items()
    }
    return next(iter(figures.values())) if len(figures) == 1 else {"teachers": figures}


def _scenes(config: ExportConfig, voxel: float) -> list[Cloud]:
    """The splats that the user gave, for the comparison."""
    clouds = []
    for path in find_scenes(config.paths) if config.paths else ():
        scene = load_scene(path, splat=config.splat or None, options=config.data)
        if scene.gaussians is None:
            scene = with_gaussians(scene, config.seeds, track=Progress(quiet=config.quiet))
        assert scene.gaussians is not None
        clouds.append(Cloud(scene.name, scene.gaussians, unit_of(scene, voxel)))
    return clouds
