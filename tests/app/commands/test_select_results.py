"""What `gsencoder select` says about its results is what the library computes."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_runs import refusal, results_of
from selected_rooms import EMBEDDINGS, read_labels, selected_room, words

from gsencoder.app import main as cli
from gsencoder.data.splats.files import load_splat
from gsencoder.fusion.folder import WORDS_FILE, save_features
from gsencoder.infer.select import find_holes, sample_views, select
from gsencoder.text.table import TextTable, save_text_table
from gsencoder.types import Scene

SCENE, KINDS = selected_room()


def stored(folder: Path, scene: Scene = SCENE, table: TextTable | None = None) -> Path:
    save_features(folder, scene, scene.features["names"], {})
    save_text_table(folder / WORDS_FILE, words() if table is None else table)
    return folder


@pytest.fixture(scope="module")
def features(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return stored(tmp_path_factory.mktemp("results") / "features")


def run(*arguments: str | Path) -> None:
    assert cli.main(["select", *map(str, arguments)]) == 0


def test_seeds_and_labels_are_counted_for_each_word(features, tmp_path, capsys):
    run(features, "query=mug,book", "threshold=0.9", f"out={tmp_path / 'out'}", "write=[objects,labels]")
    output = capsys.readouterr().out
    expected, _ = select(SCENE, ("mug", "book"), words(), threshold=0.9)
    seeds = [int((expected.seeds == label).sum()) for label in (1, 2)]
    counts = [int((expected.labels == label).sum()) for label in (1, 2)]
    assert seeds[0] < counts[0]
    results = results_of(tmp_path / "out")
    assert results["seeds"] == seeds
    assert [row["count"] for row in results["selection"]["labels"][1:]] == counts
    assert results["metres_per_unit"] == 1.0
    for name, seed, count in zip(("mug", "book"), seeds, counts, strict=True):
        assert f"{name}: {count:,} Gaussians, from {seed:,} to start with, {name}.ply" in output
    part = load_splat(tmp_path / "out" / "mug.ply", origin=SCENE.origin)
    np.testing.assert_allclose(part.means, SCENE.gaussians.means[expected.labels == 1], atol=1e-4)


@pytest.mark.parametrize("under", [True, False])
def test_holes_are_those_of_the_objects_in_each_view(tmp_path, capsys, under):
    scene, _ = selected_room(under=under)
    folder = stored(tmp_path / "features", scene)
    run(folder, "query=mug", f"out={tmp_path / 'out'}")
    output = " ".join(capsys.readouterr().out.split())
    made = json.loads((tmp_path / "out" / "holes.json").read_text())
    assert scene.gaussians is not None
    selection, _ = select(scene, ("mug",), words())
    cameras = scene.views.cameras
    holes = find_holes(scene.gaussians, cameras, selection.labels > 0, sample_views(cameras, 48))
    removed, pixels = sum(hole.removed for hole in holes), sum(hole.pixels for hole in holes)
    assert made == {
        "views": 8, "views_with_objects": len(holes), "views_with_holes": sum(hole.pixels > 0 for hole in holes),
        "pixels": pixels, "removed": removed,
        "largest_area": pytest.approx(max(hole.area for hole in holes)),
        "by_view": [
            {"view": scene.views.names[hole.view], "pixels": hole.pixels, "removed": hole.removed,
             "area": pytest.approx(hole.area)}
            for hole in holes if hole.pixels
        ],
    }  # fmt: skip
    assert f"nothing is behind {pixels / removed:.0%} of the removed pixels in {len(holes)} views" in output


def test_a_box_that_is_asked_for_and_settings_of_boxes_reach_the_selection(features, tmp_path, capsys):
    scene_features = SCENE.features["names"]
    vectors = scene_features.features.copy()
    vectors[KINDS == 1] = 0.8 * EMBEDDINGS[0] + 0.2 * EMBEDDINGS[2]
    folder = stored(tmp_path / "two", replace(SCENE, features={"names": replace(scene_features, features=vectors)}))
    run(folder, "query=mug", "box=1", f"out={tmp_path / 'out'}", "write=labels", "quiet=true")
    assert ((read_labels(tmp_path / "out").labels == 1) == (KINDS == 1)).mean() > 0.99
    common = ("select", str(features), "query=mug", f"out={tmp_path / 'none'}")
    assert "no Gaussian of table is selected" in refusal(capsys, *common, "localize.min_weight=1e30")
    assert "siglip" in refusal(capsys, *common, "head=siglip")
