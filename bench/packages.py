"""Packed features against the fused ones: bytes, error, and what boxes are found with each.

python bench/packages.py SCENE … [--budgets 0.003,0.01,0.03,0.1]
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

from json_option import add_json_option, write_figures

from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.benchmarks.localization import LocalizationProtocol, score_queries, scores
from gsencoder.evaluate.sources import fusion_source, with_features
from gsencoder.fusion.package import PACKAGE_FILE, open_package, save_package
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.teachers.build import TeacherConfig, text_table_of
from gsencoder.teachers.labels import LabelsConfig


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--budgets", default="0.003,0.01,0.03,0.1")
    add_json_option(parser)
    chosen = parser.parse_args()
    teacher: TeacherConfig = LabelsConfig()
    words = text_table_of(teacher)
    protocol, localization = LocalizationProtocol(), LocalizeConfig()
    hits = {budget: [] for budget in (0.0, *map(float, chosen.budgets.split(",")))}
    shares = {budget: list[float]() for budget in hits}
    errors = {budget: list[float]() for budget in hits}
    for path in chosen.scenes:
        scene, features, _ = with_features(load_scene(path), fusion_source(teacher, words), SeedConfig())
        hits[0.0] += score_queries(scene, features, words, protocol, localization)[0]
        for budget in list(hits)[1:]:
            with TemporaryDirectory() as name:
                file = Path(name) / PACKAGE_FILE
                save_package(file.parent, scene, features, error=budget)
                packed = open_package(file)
                shares[budget].append(2 * features.space.channels * len(features) / file.stat().st_size)
                errors[budget].append(packed.error)
                hits[budget] += score_queries(scene, packed.features(), words, protocol, localization)[0]
    figures = {}
    for budget, found in hits.items():
        told = scores(found)
        figures[budget] = dict(told)
        if budget:
            figures[budget] |= {"smaller": min(shares[budget]), "error": max(errors[budget])}
        print(
            f"{budget}: Acc@0.25 {told['acc_25']:.3f}, Acc@0.5 {told['acc_50']:.3f}, mean IoU {told['mean_iou']:.3f}"
            + (f"; 1/{min(shares[budget]):.0f} or less, largest error {max(errors[budget]):.4f}" if budget else "")
        )
    write_figures(chosen.json, figures)


if __name__ == "__main__":
    main()
