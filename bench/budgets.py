"""Whether budgets of fusion hold, and what choosing costs.

    python bench/budgets.py SCENE… [--error 0.01] [--teacher labels|palette|MODEL.onnx] [--out budgets.csv]

A line for each scene: the limit, the error on a tenth of the Gaussians that `preset=exact` sees, the same
over all of them, the number of views, and CPU seconds of choosing, of the fusion and of the fusion at exact. Maps that
are made while choosing are used by the fusion and count to that. `cpu_exact` counts every map, those that were made
before at the mean of the others.
"""

import argparse
import csv
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from json_option import add_json_option, write_figures

from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.fusion.basis import field_error, judge
from gsencoder.fusion.budget import BudgetFusion, FusionBudget, exact_config, fuse_within
from gsencoder.fusion.checkpoint import CachedTeacher, WrappedTeacher
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.teachers.base import Teacher
from gsencoder.teachers.build import TeacherConfig, words_of
from gsencoder.teachers.labels import LabelsConfig, PaletteConfig
from gsencoder.teachers.onnx import OnnxConfig
from gsencoder.types import FeatureMap, Scene, Views


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
    return scene, config.build(scene, words_of(config))


def measured(scene: Scene, teacher: Teacher, error: float, maps: Path) -> tuple[dict[str, Any], BudgetFusion, Any]:
    """The line of a scene, what was fused, and the exact features."""
    base, budget = FuseConfig(), FusionBudget(error=error)
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
        "limit": error,
        "realised": judge(made.fusion.features, exact).total,
        "over_all": field_error(made.fusion.features, exact, sample=0).total,
        "predicted": made.choice.estimate.error,
        "bound": made.choice.estimate.bound,
        "views": made.choice.setting,
        "rank": made.fusion.features.features.shape[1],
        "cpu_choosing": choosing,
        "cpu_fusion": fusing,
        "cpu_exact": cpu_exact,
        "choosing_of_exact": choosing / cpu_exact,
        "map_seconds": counted.seconds / max(counted.made, 1),
    }
    return line, made, exact


def sum_of_maps(made: BudgetFusion, counted: CountedTeacher) -> float:
    """CPU seconds of the maps that were made while choosing."""
    return len(made.teacher.maps) * counted.seconds / max(counted.made, 1)


def summary_of(lines: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Limits of error and how many were kept, the largest error by its limit, and the CPU time of choosing.

    Args:
        lines: with `limit`, `realised` and `choosing_of_exact`.
    """
    return {
        "limits": len(lines),
        "kept": sum(line["realised"] <= line["limit"] for line in lines),
        "largest error by its limit": max(line["realised"] / line["limit"] for line in lines),
        "largest share of choosing": max(line["choosing_of_exact"] for line in lines),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--teacher", default="labels")
    parser.add_argument("--skip-tokens", type=int, default=0, help="of an ONNX model, before those of patches")
    parser.add_argument("--error", type=float, default=0.01)
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
                line, _, _ = measured(scene, teacher, chosen.error, Path(maps))
                measurements.append(line)
                for each in [line]:
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
