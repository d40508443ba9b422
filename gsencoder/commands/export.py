"""`gsencoder export weights=… out=FILE.onnx`: an encoder as one file that runs without torch."""

from dataclasses import dataclass, field
from pathlib import Path

from gsencoder.config import CommonConfig
from gsencoder.data.atomic import atomic_file
from gsencoder.data.scenes import SceneConfig, find_scenes, load_scene
from gsencoder.data.seeds import SeedConfig, with_gaussians
from gsencoder.data.spacing import unit_of
from gsencoder.data.splats import READABLE
from gsencoder.errors import InputError
from gsencoder.infer.encode import TorchEncoder
from gsencoder.infer.export_onnx import TOLERANCE, check_parity, export_onnx, random_cloud
from gsencoder.infer.onnx_runtime import SUFFIX
from gsencoder.outputs import refuse_existing, write_json
from gsencoder.progress import Progress, console
from gsencoder.summary import Summary
from gsencoder.types import Gaussians


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportConfig(CommonConfig):
    """Settings of `export`."""

    paths: tuple[str, ...] = field(
        default=(),
        metadata={"help": "splats or scenes to compare on, beside random clouds; may be left out", "metavar": "SPLAT"},
    )
    weights: str = field(
        default="house_cpu",
        metadata={"help": "what `train` wrote: its folder or file, or a name that comes with gsencoder"},
    )
    out: Path | None = field(
        default=None,
        metadata={
            "help": "the .onnx file to write; FILE.summary.json beside it says how well it agrees",
            "metavar": "FILE",
            "required": True,
        },
    )
    sizes: tuple[int, ...] = field(
        default=(1, 2, 31, 1000, 20000), metadata={"help": "Gaussians of the random clouds to compare on"}
    )
    tolerance: float = field(
        default=TOLERANCE, metadata={"help": "largest difference from torch, as a share of the largest output"}
    )
    splat: str = field(default="", metadata={"help": f"Gaussians of scenes; empty = seeds. {READABLE}"})
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)

    def __post_init__(self) -> None:
        if not self.sizes or min(self.sizes) < 1:
            raise InputError(f"sizes: expected one or more numbers from 1, got {list(self.sizes)}")
        if not 0 < self.tolerance < 1:
            raise InputError(f"tolerance: expected a share between 0 and 1, got {self.tolerance}")


def run(config: ExportConfig, summary: Summary) -> None:
    """Exports, compares, and writes only what agrees."""
    assert config.out is not None
    if config.out.suffix.lower() != SUFFIX:
        raise InputError(f"out: expected a file that ends in {SUFFIX}, got {config.out.name}")
    refuse_existing(config.out, config.overwrite)
    with summary.step("load"):
        encoder = TorchEncoder(config.weights)
        clouds = [(f"{size} random Gaussians", random_cloud(size, encoder.voxel), 1.0) for size in config.sizes]
        clouds += _real(config, encoder.voxel)
    screen = console(config.quiet)
    screen.print("translating the graph, which takes about a minute")
    with summary.step("export"):
        model = export_onnx(encoder)
    with summary.step("compare"):
        parity = check_parity(model, encoder, clouds, tolerance=config.tolerance, track=Progress(quiet=config.quiet))
    with summary.step("write"), atomic_file(config.out) as stream:
        stream.write(model)
    summary.results.update(
        onnx=str(config.out),
        bytes=len(model),
        parity=parity,
        gaussians={name: len(cloud) for name, cloud, _ in clouds},
        channels=encoder.outputs.space.channels,
        rank=encoder.outputs.channels,
        words=0 if encoder.words is None else len(encoder.words),
        space=encoder.outputs.space.describe(),
    )
    write_json(f"{config.out}.summary.json", summary.to_dict())
    screen.print(
        f"{config.out}: {len(model) / 1e6:.1f} MB; within {max(parity.values()):.1g} of torch's largest output on "
        f"{len(parity)} clouds of {min(map(_size, clouds)):,} to {max(map(_size, clouds)):,} Gaussians"
    )


def _size(cloud: tuple[str, Gaussians, float]) -> int:
    return len(cloud[1])


def _real(config: ExportConfig, voxel: float) -> list[tuple[str, Gaussians, float]]:
    """The user's own clouds."""
    clouds = []
    for path in find_scenes(config.paths) if config.paths else ():
        scene = load_scene(path, splat=config.splat or None, options=config.data)
        if scene.gaussians is None:
            scene = with_gaussians(scene, config.seeds)
        assert scene.gaussians is not None
        clouds.append((scene.name, scene.gaussians, unit_of(scene, voxel)))
    return clouds
