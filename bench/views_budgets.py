"""Whether budgets of error of `views` hold, and how many views they take.

    python bench/views_budgets.py FEATURES… --scenes FOLDER [--errors 0.02,0.05,0.1,0.2] [--most 9]
    python bench/views_budgets.py FEATURES… --queries table,chair

Each FEATURES is a folder of features; each name of its scene's objects.json in FOLDER, or each query, is a target by
itself where it has a box. A line for each target and limit: views, the error by the small renders, the error at the
size of the pictures, and that of the eight views that are chosen without a budget.
"""

import argparse
import csv
import json
import warnings
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.app.scenes import load_query
from gsencoder.core.errors import SceneWarning
from gsencoder.fusion.folder import load_features
from gsencoder.infer.localize import LocalizeConfig, localize
from gsencoder.infer.views.budget import ViewsBudget, fewest_views, measured_errors
from gsencoder.infer.views.candidates import FreeSpace
from gsencoder.infer.views.choose import CoverageObjective, score_candidates
from gsencoder.infer.views.targets import ViewsConfig, targets_of


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", metavar="FEATURES")
    names_from = parser.add_mutually_exclusive_group(required=True)
    names_from.add_argument("--scenes", type=Path)
    names_from.add_argument("--queries")
    parser.add_argument("--errors", default="0.02,0.05,0.1,0.2")
    parser.add_argument("--most", type=int, default=9, help="targets of each scene")
    parser.add_argument("--out", type=Path, default=Path("views_budgets.csv"))
    add_json_option(parser)
    given = parser.parse_args()
    warnings.simplefilter("ignore", SceneWarning)
    config, errors, lines = ViewsConfig(), [float(each) for each in given.errors.split(",")], []
    for folder in given.folders:
        scene = load_features(folder)
        queried, words = load_query(scene, folder)
        gaussians = scene.gaussians
        if given.scenes is None:
            names = given.queries.split(",")
        else:
            objects = json.loads((given.scenes / scene.name / "objects.json").read_text())
            names = list(dict.fromkeys(each["name"] for each in objects if each["name"]))
        targets = targets_of(gaussians, localize(queried, names, words, LocalizeConfig()))[: given.most]
        free = FreeSpace(gaussians)
        for target in targets:
            candidates = score_candidates(scene, [target], config, free)
            cameras, scores = candidates.cameras, candidates.scores
            usual, _ = CoverageObjective(cameras, [target], scores, config.count).greedy(config.count)
            fewest = [fewest_views(scores, ViewsBudget(error=error))[0] for error in errors]
            choices = [usual, *(choice.setting for choice in fewest)]
            near = free.blend.near
            usual_error, *realised = measured_errors(gaussians, [target], cameras, choices, near=near)
            for error, choice, measured in zip(errors, fewest, realised, strict=True):
                lines.append(
                    {
                        "scene": scene.name,
                        "target": target.name,
                        "gaussians": len(target.rows),
                        "candidates": len(cameras),
                        "limit": error,
                        "views": len(choice.setting),
                        "predicted": choice.estimate.error,
                        "realised": measured,
                        "usual_views": len(usual),
                        "usual_realised": usual_error,
                    }
                )
                print(lines[-1], flush=True)
    with given.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(lines[0]))
        writer.writeheader()
        for line in lines:
            writer.writerow({key: f"{value:.4g}" if isinstance(value, float) else value for key, value in line.items()})
    figures = {}
    for error in errors:
        of_error = [line for line in lines if line["limit"] == error]
        figures[f"limits of {error:g} kept"] = sum(line["realised"] <= error for line in of_error)
        figures[f"views for {error:g}"] = float(np.mean([line["views"] for line in of_error]))
    print({"targets": len(lines) // len(errors), **figures})
    write_figures(given.json, figures)


if __name__ == "__main__":
    main()
