"""Whether budgets of fusion hold, and what choosing costs; with --grid, how near choices are to the cheapest setting.

    python bench/budgets.py SCENE… [--error 0.01] [--teacher labels|palette|MODEL.onnx] [--out budgets.csv]
    python bench/budgets.py SCENE --grid [--out grid.csv]

A line for each scene: the promise, the error on a tenth of the Gaussians that `preset=exact` sees, the same over
all of them, the chosen knobs, and CPU seconds of choosing, of the fusion and of the fusion at exact. Maps that are made
while choosing are used by the fusion and count to that. `cpu_exact` counts every map, those that were made before at
the mean of the others.

--grid measures every combination of numbers of views (in the order of the choice), rays, their ends and ranks, or
smallest weights where the teacher has few channels, after the choice itself: the cheapest one that keeps the promise,
maps included, is to be held against the choice.
"""

import argparse
import csv
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from budget_figures import summary_of
from json_option import add_json_option, write_figures

from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.fusion.budget import BudgetFusion, fuse_within
from gsencoder.fusion.checkpoint import CachedTeacher, WrappedTeacher
from gsencoder.fusion.cost_model import BudgetConfig, exact_config
from gsencoder.fusion.errors import field_error, judge
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.teachers.base import Teacher
from gsencoder.teachers.build import TeacherConfig, build_teacher, words_of
from gsencoder.teachers.labels import LabelsConfig, PaletteConfig
from gsencoder.teachers.onnx import OnnxConfig
from gsencoder.types import FeatureMap, GaussianFeatures, Scene, Views


class CountedTeacher(WrappedTeacher):
    """A teacher that counts the CPU seconds of its maps.

    Attributes:
        seconds: of all maps so far.
        made: number of maps so far.
    """

    def __init__(self, teacher: Teacher) -> None:
        super().__init__(teacher)
        self.seconds, self.made = 0.0, 0

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        start = time.process_time()
        try:
            return self.teacher.feature_map(views, view)
        finally:
            self.seconds += time.process_time() - start
            self.made += 1


def teacher_config(name: str, skip_tokens: int) -> TeacherConfig:
    if name in ("labels", "palette"):
        return LabelsConfig() if name == "labels" else PaletteConfig()
    return OnnxConfig(model=name, skip_tokens=skip_tokens)


def opened(path: Path, config: TeacherConfig) -> tuple[Scene, Teacher]:
    """A scene with Gaussians, and its teacher."""
    scene = with_gaussians(load_scene(path, options=SceneConfig()), SeedConfig())
    return scene, build_teacher(config, scene, words_of(config))


def measured(scene: Scene, teacher: Teacher, error: float, maps: Path) -> tuple[dict[str, Any], BudgetFusion, Any]:
    """The line of a scene, what was fused, and the exact features."""
    base, budget = FuseConfig(), BudgetConfig(error=error)
    counted = CountedTeacher(teacher)
    cached = counted if teacher.cheap else CachedTeacher(counted, maps)
    made = fuse_within(scene, cached, base, budget, clock=time.process_time)
    choosing = made.choosing - sum_of_maps(made, counted)
    fusing = made.seconds - choosing
    start, before, number = time.process_time(), counted.seconds, counted.made
    exact = fuse(scene, cached, exact_config(base)).features
    missing = max(len(scene.views or ()) - (counted.made - number), 0) if not teacher.cheap else 0
    cpu_exact = time.process_time() - start + missing * before / max(number, 1)
    line = {
        "scene": scene.name,
        "gaussians": len(made.fusion.features),
        "all_views": len(scene.views or ()),
        "promise": error,
        "realised": judge(made.fusion.features, exact).total,
        "over_all": field_error(made.fusion.features, exact, sample=0).total,
        "predicted": made.choice.predicted.error,
        "deviation": made.choice.predicted.deviation,
        **{name: made.choice.knobs.get(name, "") for name in ("views", "stop_transmittance", "rank")},
        "cpu_choosing": choosing,
        "cpu_fusion": fusing,
        "cpu_exact": cpu_exact,
        "choosing_of_exact": choosing / cpu_exact,
        "rays_followed": made.choice.followed / made.choice.all_rays,
        "scatter": made.choice.scatter,
        "map_seconds": counted.seconds / max(counted.made, 1),
    }
    return line, made, exact


def sum_of_maps(made: BudgetFusion, counted: CountedTeacher) -> float:
    """CPU seconds of the maps that were made while choosing."""
    return len(made.choice.maps) * counted.seconds / max(counted.made, 1)


def grid(made: BudgetFusion, exact: GaussianFeatures, error: float, map_seconds: float) -> Iterator[dict[str, Any]]:
    """CPU seconds and error of every combination, the choice first. Maps are made before and count for what they cost
    on average."""
    count, chosen = len(made.scene.views or ()), made.choice
    few = made.fusion.features.basis is None
    numbers = sorted({max(1, round(count * share)) for share in np.linspace(0.15, 1, 7)})
    exact_rays = chosen.config.blend.rays_per_patch
    rays, ends = sorted({1, 4, 16, exact_rays}), (1e-6, 1e-3, 1e-2)
    fourth = (0.0, 1e-4, 1e-3, 1e-2) if few else (16, 32, 64, 0)
    ours = (len(chosen.rows), exact_rays, chosen.config.blend.stop_transmittance)
    last_of_ours = chosen.config.blend.min_weight if few else chosen.config.max_rank
    for number, side, stop, last in ((*ours, last_of_ours), *product(numbers, rays, ends, fourth)):
        base = FuseConfig()
        blend = replace(base.blend, rays_per_patch=side, stop_transmittance=stop)
        config = replace(base, blend=replace(blend, min_weight=last)) if few else replace(base, blend=blend, energy=1.0)
        config = config if few else replace(config, max_rank=int(last))
        start = time.process_time()
        features = fuse(made.scene, made.teacher, config, rows=sorted(chosen.order[:number])).features
        cpu = time.process_time() - start
        total = judge(features, exact).total
        setting = {"views": number, "rays": side, "stop": stop, "fourth": last}
        yield {**setting, "cpu": cpu, "cpu_maps": number * map_seconds, "error": total, "kept": total <= error}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--teacher", default="labels")
    parser.add_argument("--skip-tokens", type=int, default=0, help="of an ONNX model, before those of patches")
    parser.add_argument("--error", type=float, default=0.01)
    parser.add_argument("--grid", action="store_true")
    parser.add_argument("--cold", action="store_true", help="measure the first scene at once, compilation included")
    parser.add_argument("--out", type=Path, default=Path("budgets.csv"))
    add_json_option(parser)
    chosen = parser.parse_args()
    config, measurements = teacher_config(chosen.teacher, chosen.skip_tokens), []
    with chosen.out.open("a", newline="") as file:
        writer = None
        for number, path in enumerate(chosen.scenes):
            scene, teacher = opened(path, config)
            with TemporaryDirectory() as maps:
                if number == 0 and teacher.cheap and not chosen.cold:
                    measured(
                        scene, teacher, chosen.error, Path(maps)
                    )  # Kernels are compiled, or read from their cache.
                line, made, exact = measured(scene, teacher, chosen.error, Path(maps))
                measurements.append(line)
                lines = [line] if not chosen.grid else grid(made, exact, chosen.error, line["map_seconds"])
                for each in lines:
                    if writer is None:
                        writer = csv.DictWriter(file, list(each))
                        writer.writeheader()
                    shown = {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in each.items()}
                    writer.writerow(shown)
                    file.flush()
                    print(each, flush=True)
    write_figures(chosen.json, summary_of(measurements))


if __name__ == "__main__":
    main()
