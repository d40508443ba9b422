"""`gsencoder export weights=… out=FILE.onnx`: an encoder as one file that runs without torch."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gsencoder.app.options import CommonConfig
from gsencoder.app.run import Run
from gsencoder.core.errors import InputError
from gsencoder.core.files import write_bytes
from gsencoder.core.process import Stored, Track
from gsencoder.core.settings import option
from gsencoder.data.scenes import SceneConfig, find_scenes, load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.data.splats.files import READABLE
from gsencoder.fusion.folder import load_memories
from gsencoder.infer.encode import Cloud, Encoder, check_cosines, check_parity, file_of_encoder
from gsencoder.infer.onnx.runtime import SUFFIX
from gsencoder.memory.attention import export_memory
from gsencoder.models.output_space import copy_heads, find_heads, heads_of_graph, teacher_of_space
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
        "rooms, which does",
    )
    memory: str = option(
        "", "folder written by `memory`, whose attention is exported, from queries to features, in place of an encoder"
    )
    space: str = option("", "teacher of the memory, if the folder holds several")
    out: Path | None = option(
        None,
        "the .onnx file; FILE.summary.json next to it holds the differences from torch",
        metavar="FILE",
        required=True,
    )
    precision: Stored = option(
        "float32",
        "what the graph computes in; int8_weights = stored in 8 bits, computed in float32; int8_dynamic = "
        "products of 8-bit integers, whose ranges are computed for each splat",
    )
    sizes: tuple[int, ...] = option(
        (1, 2, 31, 1000, 20000), "numbers of Gaussians of the random clouds for the comparison", ge=1, le=MAX_SIZE
    )
    splat: str = option("", f"Gaussians of scenes; empty = seeds. {READABLE}")
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)

    def __post_init__(self) -> None:
        CommonConfig.__post_init__(self)
        if not self.sizes:
            raise InputError("sizes: expected one or more numbers of Gaussians, got none")
        if self.memory and self.weights:
            raise InputError("memory, weights: expected one of the two, a memory or an encoder")
        if self.space and not self.memory:
            raise InputError("space: names a teacher of memory=; leave it out, or give memory=")
        if self.memory and self.paths:
            raise InputError("paths: splats are compared with encoders alone; leave them out with memory=")
        if self.memory and self.precision != "float32":
            raise InputError(f"precision: expected float32 with memory=, got {self.precision}")


def run(config: ExportConfig, run: Run) -> None:
    """Exports, compares with torch, and writes the file if it agrees."""
    assert config.out is not None
    if config.out.suffix.lower() != SUFFIX:
        raise InputError(f"out: expected a file that ends in {SUFFIX}, got {config.out.name}")
    if config.weights.lower().endswith(SUFFIX):
        raise InputError(f"weights: {config.weights} is an exported graph already; give the encoder that `train` wrote")
    run.check_files(config.out, heads_of_graph(config.out))
    if config.memory:
        _export_memory(config, config.out, run)
        return
    from gsencoder.infer.onnx.export import export_onnx, random_cloud

    with run.step("load"):
        encoder = Encoder.load(config.weights)
        network = encoder.network
        heads = find_heads(file_of_encoder(config.weights))
        clouds = [Cloud(f"{size} random Gaussians", random_cloud(size, encoder.voxel)) for size in config.sizes]
        scenes = _scenes(config, run.track)
    run.print("translating the graph, which takes about a minute")
    with run.step("export"):
        lowered = network.lower()
        exact = model = export_onnx(network.header, lowered)
    with run.step("compare"):
        parity = check_parity(exact, encoder, [*clouds, *scenes], track=run.track)
    agreement = f"within {max(parity.values()):.1g} of torch's largest output"
    cosines: dict[str, float] = {}
    if config.precision != "float32":
        with run.step("convert"):
            if config.precision == "float16":
                lowered = network.lower(half=True)
            model = export_onnx(replace(network.header, precision=config.precision), lowered)
        with run.step("judge"):
            cosines = check_cosines(model, exact, scenes or clouds, track=run.track)
        agreement = (
            f"{config.precision}, {len(model) / len(exact):.2f} of float32's size, mean centered cosine to it "
            f"{min(cosines.values()):.4f} or more"
        )
    sizes = {cloud.name: len(cloud.gaussians) for cloud in (*clouds, *scenes)}
    compared = [sizes[name] for name in cosines or parity]
    run.results.update(
        onnx=str(config.out),
        precision=config.precision,
        bytes=len(model),
        bytes_float32=len(exact),
        parity=parity,
        cosines=cosines,
        gaussians=sizes,
        **space_figures(encoder),
    )
    with run.file(config.out):
        with run.step("write"):
            write_bytes(config.out, model)
        if heads is None:
            # Those of a file that was replaced.
            heads_of_graph(config.out).unlink(missing_ok=True)
        else:
            copy_heads(heads, heads_of_graph(config.out), list(encoder.spaces.values()))
    if heads is not None:
        run.print(f"{heads_of_graph(config.out)}: the adapter heads that take its features; keep it next to the file")
    run.print(
        f"{config.out}: {len(model) / 1e6:.1f} MB; {agreement} on {len(compared)} clouds of {min(compared):,} to "
        f"{max(compared):,} Gaussians"
    )


def _export_memory(config: ExportConfig, out: Path, run: Run) -> None:
    """Writes the attention of a memory."""
    with run.step("load"):
        memories = load_memories(config.memory)
        memory = _memory_of(memories, config.space)
    with run.step("export"):
        model = export_memory(memory)
    run.results.update(onnx=str(out), bytes=len(model), components=len(memory.bank), space=memory.space.describe())
    with run.file(out), run.step("write"):
        write_bytes(out, model)
    run.print(
        f"{out}: {len(model) / 1e6:.1f} MB; features of {memory.space.channels} channels from queries of "
        f"{memory.channels}, by attention to {len(memory.bank):,} components"
    )


def _memory_of(memories: Mapping[str | None, QueryMemory], space: str) -> QueryMemory:
    """The memory of a teacher, by its name in the folder or that of its feature space."""
    spaces = {name or memory.space.name: memory.space for name, memory in memories.items()}
    name = teacher_of_space(spaces, space or None)
    return next(memory for memory in memories.values() if memory.space == spaces[name])


def space_figures(encoder: Encoder) -> dict[str, Any]:
    """Channels, rank, words and space of an encoder, by teacher where there are several."""
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


def _scenes(config: ExportConfig, track: Track) -> list[Cloud]:
    """The splats that the user gave, for the comparison."""
    clouds = []
    for path in find_scenes(config.paths) if config.paths else ():
        scene = load_scene(path, splat=config.splat or None, options=config.data)
        if scene.gaussians is None:
            scene = with_gaussians(scene, config.seeds, track=track)
        assert scene.gaussians is not None
        clouds.append(Cloud(scene.name, scene.gaussians, unit_of(scene)))
    return clouds
