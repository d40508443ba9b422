"""What frozen geometry costs a memory: queries on a finished splat, beside geometry and queries optimized together.

    python bench/left_out.py write SCENE OUT
    python bench/joint.py OUT [--splat FILE] [--teacher dinov2_s14] [--steps 600] [--weights 0.1 1] [--shrink 2]

M3 optimizes both in one loop: of each photograph, the photometric loss and the losses of the rendered queries, whose
gradients reach means, rotations, scales and opacities. The rows, of one number of steps each from one splat (that of
--splat, or the seeds of OUT/kept):

- frozen: photographs move the geometry, and then the queries are trained on it, `gsencoder memory`'s way;
- frozen, in this loop: the queries of that geometry in the loop of the rows below, whose steps look at one photograph
  with all channels rasterized, instead of rows of B;
- joint: both at once, the losses of the queries with a weight for the geometry.

Photographs and feature maps of OUT/left_out say how good each is: PSNR after an affine fit of colors, which exposures
ask for, and cosines of rendered features with the teacher's, as `bench/memory.py` prints them. Queries are rasterized
in passes of three channels with the rays of a Blend: a grid of 4 × 4 rays a cell, with the low-pass filter of the full
picture.
"""

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from jaxtyping import Float, Int64
from memory import MIN_ALPHA, Case, score
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from gsencoder.app.commands.fuse import FuseCommandConfig
from gsencoder.app.compose import compose
from gsencoder.data.photographs import Photographs
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.fusion.basis import to_coordinates
from gsencoder.memory.attention import MemoryAttention
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer, PruneConfig
from gsencoder.reconstruct.parameters import RowAdam, camera_of, gaussians_of, parameters_from, rows_in_view
from gsencoder.render import blend
from gsencoder.render.images import psnr
from gsencoder.render.rasterize import RasterConfig, rasterize
from gsencoder.teachers.base import Teacher
from gsencoder.teachers.build import build_teacher, words_of
from gsencoder.train.memory import (
    MemoryConfig,
    MemoryScene,
    first_queries,
    memory_training,
    prepare_memory,
    train_memory,
)
from gsencoder.types import FeatureMap, Gaussians, QueryMemory, Scene

EPS = 1e-12
RAYS = 4
"""Rays along each side of a cell."""
SPLAT = "splat.ply"
SHAPE = ("means", "quats", "log_scales", "logit_opacities")


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """What all rows have in common."""

    kept: Scene
    left_out: Scene
    teacher: Teacher
    photographs: Photographs
    unseen: Photographs
    maps: list[FeatureMap]
    unseen_maps: list[FeatureMap]
    optimize: OptimizeConfig
    memory: MemoryConfig
    work: Path


class QueryLoop:
    """Queries and projection on their way, over rasterized views of a splat."""

    def __init__(self, setting: Setting, scene: MemoryScene) -> None:
        self._setting, self._scene = setting, scene
        queries, projection = first_queries(scene, setting.memory, 0)
        self.adam = RowAdam({"queries": torch.from_numpy(queries)})
        self.attention = MemoryAttention(
            scene.bank,
            torch.from_numpy(projection),
            mean=scene.outputs.mean,
            scoring=setting.memory.scoring,
            temperature=setting.memory.temperature,
            values=torch.from_numpy(scene.values),
        )
        self._projection = torch.optim.Adam([self.attention.projection])
        self._targets = [self._standard(each) for each in setting.maps]
        self._rng = np.random.default_rng(0)
        self._training = replace(memory_training(), steps=setting.optimize.steps)

    def _standard(self, feature_map: FeatureMap) -> Tensor:
        outputs, rows = self._scene.outputs, feature_map.rows()
        return torch.from_numpy(
            outputs.standardize(rows if outputs.basis is None else to_coordinates(outputs.basis, rows))
        )

    def slopes(
        self, raw: dict[str, Tensor], view: int
    ) -> tuple[Int64[Tensor, " n"], dict[str, Tensor], Float[Tensor, "n s"]]:
        """Rows in view, and the gradients of 1 − cosine + L2 in sampled cells by their shapes and their queries."""
        cameras, grid = self._setting.kept.views.cameras, self._setting.maps[view].features.shape[:2]
        height, width = RAYS * grid[0], RAYS * grid[1]
        pose, _ = camera_of(cameras, view, "cpu")
        shrink = np.array([width / cameras.widths[view], height / cameras.heights[view], 1])
        K = torch.from_numpy((cameras.Ks[view] * shrink[:, None]).astype(np.float32))
        config = RasterConfig(eps2d=0.3 * float(shrink[0] * shrink[1]))
        rows = rows_in_view(raw, pose, K, width, height, near=config.near, eps2d=config.eps2d)
        seen = {name: raw[name][rows].requires_grad_() for name in SHAPE}
        queries = self.adam.parameters["queries"][rows].requires_grad_()
        shape = (seen["means"], seen["quats"], seen["log_scales"].exp(), seen["logit_opacities"].sigmoid())
        padded = torch.cat((queries, queries.new_zeros(len(queries), -queries.shape[1] % 3)), dim=1)
        passes = [rasterize(*shape, part, pose, K, width, height, config=config) for part in padded.split(3, dim=1)]
        pictures = torch.cat([*(each.rgb for each in passes), passes[0].alpha[..., None]], dim=-1)
        cells = adaptive_avg_pool2d(pictures.permute(2, 0, 1)[None], grid)[0].flatten(1).T
        alpha, targets = cells[:, -1], self._targets[view]
        usable = ((alpha.detach() >= MIN_ALPHA) & torch.isfinite(targets[:, 0])).nonzero()[:, 0].numpy()
        chosen = torch.from_numpy(self._rng.permutation(usable)[: self._setting.memory.points])
        rendered = cells[chosen, : queries.shape[1]] / alpha[chosen, None].clamp(min=EPS)
        predicted, target = self.attention(rendered), targets[chosen]
        cosines = torch.nn.functional.cosine_similarity(predicted, target, dim=1)
        loss = (1 - cosines).mean() + (predicted - target).square().mean()
        self._projection.zero_grad()
        loss.backward()
        return rows, {name: value.grad for name, value in seen.items()}, queries.grad

    def advance(self, rows: Tensor, gradient: Tensor, step: int) -> None:
        rate = rate_at(step, self._training.steps, self._training.learning_rate, self._training.warmup)
        self.adam.step(rows, {"queries": gradient}, {"queries": rate})
        self._projection.param_groups[0]["lr"] = rate
        self._projection.step()

    def memory(self) -> QueryMemory:
        outputs = self._scene.outputs
        return QueryMemory(
            queries=self.adam.parameters["queries"].numpy(),
            weights=np.array(self._scene.prepared.weights),
            projection=self.attention.projection.detach().numpy(),
            bank=self._scene.bank,
            scoring=self._setting.memory.scoring,
            temperature=self._setting.memory.temperature,
            mean=outputs.mean,
            basis=outputs.basis,
        )


def rate_at(step: int, steps: int, highest: float, warmup: int) -> float:
    """Linear warm-up, then a half cosine down to a hundredth, as in the training of memories."""
    if step < warmup:
        return highest * (step + 1) / warmup
    progress = (step - warmup) / max(steps - warmup, 1)
    return highest * (0.01 + 0.99 * (1 + math.cos(math.pi * progress)) / 2)


def optimizer_of(setting: Setting, gaussians: Gaussians) -> Optimizer:
    return Optimizer(
        RowAdam(parameters_from(gaussians, setting.optimize.sh_degree)),
        setting.photographs,
        range(len(setting.photographs)),
        setting.optimize,
        prune=PruneConfig(),
    )


def run(setting: Setting, gaussians: Gaussians, loop: QueryLoop | None, weight: float | None) -> Gaussians:
    """Steps over photographs: of the geometry alone, of the queries alone (no weight), or of both."""
    optimizer = optimizer_of(setting, gaussians)
    for step in range(setting.optimize.steps):
        view = optimizer.view_at(step)
        if loop is not None:
            rows, shapes, of_queries = loop.slopes(optimizer.parameters, view)
            loop.advance(rows, of_queries, step)
        if loop is not None and weight is None:
            continue
        photo = optimizer.gradients(view, 1)
        grads = {name: torch.zeros_like(value) for name, value in optimizer.parameters.items()}
        for name, value in photo.grads.items():
            grads[name].index_add_(0, photo.rows, value)
        touched = photo.rows
        if loop is not None:
            for name, value in shapes.items():
                grads[name].index_add_(0, rows, weight * value)
            touched = torch.unique(torch.cat([photo.rows, rows]))
        step_grads = {name: value[touched] for name, value in grads.items()}
        optimizer.adam.step(touched, step_grads, setting.optimize.rates_at(step, optimizer.extent))
        if optimizer.exposures is not None and photo.colors is not None:
            optimizer.exposures.set(view, photo.colors)
        optimizer.step += 1
    return gaussians_of(optimizer.parameters)


@torch.no_grad()
def matched_psnr(setting: Setting, gaussians: Gaussians) -> float:
    """In the photographs that were left out, after an affine fit of the colors of each."""
    raw, values = parameters_from(gaussians, setting.optimize.sh_degree), []
    shown = Optimizer(
        RowAdam(raw), setting.unseen, range(len(setting.unseen)), setting.optimize, prune=PruneConfig(), step=1
    )
    for view in range(len(setting.unseen)):
        photo = setting.unseen.at_scale(view)
        values.append(psnr(shown.pictures(view, photo, torch.eye(3, 4)).matched, photo.image, photo.mask))
    return float(np.mean(values))


def case_of(setting: Setting, name: str, gaussians: Gaussians) -> Case:
    """The memory's preparation on some geometry, and what is left out as it sees it."""
    scene = prepare_memory(replace(setting.kept, gaussians=gaussians), setting.teacher, setting.work / name)
    return replace_views(setting, Case(name=name, scene=scene, left_out=[], seconds=0.0), gaussians)


def replace_views(setting: Setting, case: Case, gaussians: Gaussians) -> Case:
    cameras = setting.left_out.views.cameras
    pairs = [(blend(gaussians, cameras, view, like=each), each) for view, each in enumerate(setting.unseen_maps)]
    return replace(case, left_out=pairs)


def row(setting: Setting, title: str, case: Case, memory: QueryMemory, gaussians: Gaussians, seconds: float) -> None:
    figures = score(case, memory.queries, lambda rendered: memory.attend(rendered.numpy()), None)
    print(f"| {title} | {matched_psnr(setting, gaussians):.2f} | {figures} | {seconds:.0f} |", flush=True)


def open_setting(folder: Path, splat: Path | None, teacher_words: str, steps: int, shrink: int, work: Path) -> Setting:
    kept = load_scene(folder / "kept", splat=str(splat or folder / "kept" / SPLAT))
    left_out = load_scene(folder / "left_out")
    small = SceneConfig(image_scale=1 / shrink)
    config = compose("fuse", FuseCommandConfig, ["-", *f"teacher={teacher_words}".split()])
    teacher = build_teacher(config.teacher, kept, words_of(config.teacher, config.text))

    def maps(scene: Scene) -> list[FeatureMap]:
        return [teacher.feature_map(scene.views, view) for view in range(len(scene.views))]

    return Setting(
        kept=kept,
        left_out=left_out,
        teacher=teacher,
        photographs=Photographs(load_scene(folder / "kept", options=small).views),
        unseen=Photographs(load_scene(folder / "left_out", options=small).views),
        maps=maps(kept),
        unseen_maps=maps(left_out),
        optimize=OptimizeConfig(steps=steps, shrinks=(1,), shares=(1.0,)),
        memory=MemoryConfig(),
        work=work,
    )


def measure(setting: Setting, weights: Sequence[float]) -> None:
    first = setting.kept.gaussians
    print("| geometry and queries | PSNR | cosine | centered | L2 | at Gaussians | seconds |")
    print("|---|---|---|---|---|---|---|")
    start = time.perf_counter()
    frozen = run(setting, first, None, None)
    photometric = time.perf_counter() - start
    case = case_of(setting, "frozen", frozen)
    start = time.perf_counter()
    with TemporaryDirectory() as work:
        memory = train_memory({"": case.scene}, setting.memory, memory_training(), work=Path(work))[0][""]
    row(setting, "frozen", case, memory, frozen, photometric + time.perf_counter() - start)
    loop, start = QueryLoop(setting, case.scene), time.perf_counter()
    run(setting, frozen, loop, None)
    seconds = photometric + time.perf_counter() - start
    row(setting, "frozen, in this loop", case, loop.memory(), frozen, seconds)
    started = case_of(setting, "start", first)
    for weight in weights:
        loop, start = QueryLoop(setting, started.scene), time.perf_counter()
        moved = run(setting, first, loop, weight)
        seconds = time.perf_counter() - start
        row(setting, f"joint, weight {weight:g}", replace_views(setting, started, moved), loop.memory(), moved, seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--splat", type=Path)
    parser.add_argument("--teacher", default="dinov2_s14")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--weights", type=float, nargs="*", default=[0.1, 1.0])
    parser.add_argument("--shrink", type=int, default=2)
    arguments = parser.parse_args()
    with TemporaryDirectory() as work:
        setting = open_setting(
            arguments.out, arguments.splat, arguments.teacher, arguments.steps, arguments.shrink, Path(work)
        )
        measure(setting, arguments.weights)


if __name__ == "__main__":
    main()
