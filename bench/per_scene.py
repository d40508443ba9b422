"""Features optimized per scene through B, beside fused and distilled ones: quality and time (SplatDistill table 7).

    python bench/per_scene.py SCENE… [--weights house_cpu] [--words clip_vitb32_names.npz] [--rounds 5,20,50]
                                     [--stride 2]

With the geometry frozen, the render loss alone is a linear least-squares problem, Σ_views |B z − alpha·t|², and is
solved by conjugate gradients on BᵀB z = Bᵀ(alpha·t), in the coordinates of the scene's basis, from zero, each Gaussian
divided by its total weight (Jacobi). Rows are the pixels of every view, one in `stride` along each axis. `fused` is the
library's fusion, `encoded` one pass of an encoder. Names and Acc@0.25 are those of `evaluate`'s two protocols.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from json_option import add_json_option, write_figures

from gsencoder.core.pretrained import find_file
from gsencoder.core.process import retain_freed_memory
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import seed
from gsencoder.evaluate.boxes import Hit, accuracy
from gsencoder.evaluate.protocols.localization import LocalizationProtocol, score_queries
from gsencoder.evaluate.protocols.naming import NamingCounts, compare_names, naming_scores
from gsencoder.evaluate.sources import encoder_source
from gsencoder.fusion.basis import to_coordinates
from gsencoder.fusion.fuse import fuse
from gsencoder.infer.encode import TorchEncoder
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.teachers.labels import LabelsTeacher
from gsencoder.text.table import TextTable, load_text_table
from gsencoder.types import FeatureMap, GaussianFeatures, Scene


def rows_of(
    scene: Scene, teacher: LabelsTeacher, fused: GaussianFeatures, stride: int
) -> Iterator[tuple[Blend, torch.Tensor]]:
    """B of each view's pixels, and alpha times the teacher's coordinates there."""
    assert scene.gaussians is not None
    assert scene.views is not None
    table = teacher.vectors if fused.basis is None else to_coordinates(fused.basis, teacher.vectors)
    for view in range(len(scene.views)):
        codes = teacher.feature_map(scene.views, view).codes
        assert codes is not None
        height, width = codes.shape
        grid = FeatureMap(
            codes=codes[stride // 2 :: stride, stride // 2 :: stride][: height // stride, : width // stride].copy(),
            table=teacher.vectors,
            grid_from_image=np.array([[1 / stride, 0, 0], [0, 1 / stride, 0]]),
            space=teacher.space,
        )
        b = blend(scene.gaussians, scene.views.cameras, view, like=grid, config=BlendConfig(rays_per_patch=1))
        assert grid.codes is not None
        yield b, b.alpha[:, None] * torch.from_numpy(table[grid.codes.ravel()])


def optimize(
    scene: Scene, teacher: LabelsTeacher, fused: GaussianFeatures, stride: int, rounds: int
) -> GaussianFeatures:
    """Conjugate gradients on the normal equations, from zero."""
    views = list(rows_of(scene, teacher, fused, stride))
    right = torch.zeros(len(fused), fused.features.shape[1])
    weights = torch.zeros(len(fused), 1)
    for b, target in views:
        b.lift_into(target, right)
        b.lift_into(torch.ones(b.rows, 1), weights)

    def normal(z: torch.Tensor) -> torch.Tensor:
        out = torch.zeros_like(z)
        for b, _ in views:
            b.lift_into(b.render(z), out)
        return out

    z, residual = torch.zeros_like(right), right.clone()
    # Columns are problems of their own that share a matrix.
    scale = 1 / (weights + 1e-3)
    direction = scale * residual
    energy = (residual * direction).double().sum(dim=0)
    for _ in range(rounds):
        image = normal(direction)
        step = (energy / (direction * image).double().sum(dim=0).clamp(min=1e-30)).float()
        z += step * direction
        residual -= step * image
        improved = scale * residual
        following = (residual * improved).double().sum(dim=0)
        direction = improved + (following / energy.clamp(min=1e-30)).float() * direction
        energy = following
    return replace(fused, features=z.numpy(), weights=weights[:, 0].numpy())


def quality(
    scene: Scene, truth: GaussianFeatures, features: GaussianFeatures, teacher: LabelsTeacher, words: TextTable
) -> tuple[NamingCounts, list[Hit]]:
    """Names told right, and boxes of the placed objects."""
    names = compare_names(scene.name, truth, features, teacher, {})
    return names, score_queries(scene, features, words, LocalizationProtocol(), LocalizeConfig())[0]


def labeled(path: str, words: TextTable) -> tuple[Scene, LabelsTeacher]:
    """A scene with seeds, and the teacher of its labels."""
    scene = load_scene(Path(path))
    scene = replace(scene, gaussians=seed(scene))
    teacher = LabelsTeacher(scene.objects, words.names, words.embeddings, text_encoder=words.space.text_encoder)
    return scene, teacher


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--weights", default="house_cpu")
    parser.add_argument("--words", default="clip_vitb32_names.npz")
    parser.add_argument("--rounds", default="5,20,50")
    parser.add_argument("--stride", type=int, default=2)
    add_json_option(parser)
    chosen = parser.parse_args()
    retain_freed_memory()
    words = load_text_table(find_file(chosen.words, "words"))
    encoder = TorchEncoder(chosen.weights)
    table: dict[str, list[tuple[NamingCounts, list[Hit], float]]] = {}
    for path in chosen.scenes:
        scene, teacher = labeled(path, words)
        start = time.perf_counter()
        truth = fuse(scene, teacher).features
        found = {"fused": (truth, time.perf_counter() - start)}
        for rounds in map(int, chosen.rounds.split(",")):
            start = time.perf_counter()
            features = optimize(scene, teacher, truth, chosen.stride, rounds)
            found[f"optimized, {rounds} rounds"] = (features, time.perf_counter() - start)
        features, spent = encoder_source(encoder)(scene)
        found["encoded"] = (features, sum(spent.values()))
        for name, (features, seconds) in found.items():
            table.setdefault(name, []).append((*quality(scene, truth, features, teacher, words), seconds))
    print("| features | names | centered cosine | Acc@0.25 | Acc@0.5 | seconds a scene |\n|---|---|---|---|---|---|")
    written = {}
    for name, rows in table.items():
        scores = naming_scores([names for names, _, _ in rows])
        hits = [hit for _, found_hits, _ in rows for hit in found_hits]
        figures = {"names": scores["accuracy"], "cosine": scores["cosine"]}
        figures |= {"Acc@0.25": accuracy(hits, 0.25), "Acc@0.5": accuracy(hits, 0.5)}
        seconds = float(np.mean([spent for _, _, spent in rows]))
        print(f"| {name} | " + " | ".join(f"{value:.3f}" for value in figures.values()) + f" | {seconds:.2f} |")
        written[name] = {**figures, "seconds": seconds}
    write_figures(chosen.json, written)


if __name__ == "__main__":
    main()
