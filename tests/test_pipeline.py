"""The commands one after the other, as a user runs them, on the scene that the demo makes."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_runs import refusal, results_of

from gsencoder.app import main as cli
from gsencoder.data.scenes import load_scene
from gsencoder.data.splats.files import load_splat
from gsencoder.evaluate.benchmarks.localization import aabb_iou

pytestmark = pytest.mark.slow

QUICK = ("views=6", "width=96", "objects=6", "quiet=true")


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demo") / "demo"
    assert cli.main(["demo", f"out={out}", *QUICK]) == 0
    return out


def test_the_demo_finds_what_was_seen_and_shows_it_in_one_page(demo: Path) -> None:
    results = results_of(demo)
    # In six small pictures half of the chair and of the mug is never seen, and the lamp's stem is too thin to seed.
    assert sum(iou >= 0.5 for iou in results["names"]["iou"].values()) >= 3
    assert results["names"]["mean_iou"] > 0.5
    assert results["colors"]["mean_iou"] > 0.4
    page = (demo / results["report"]).read_text()
    # Everything is in the page, but for a link to the room as a page of its own.
    assert not re.findall(r'(?:src|href)="(?!data:|#|page\.html")', page)
    for heading in ("Input", "Gaussians", "Features", "Where is each object?", "Seconds of each step"):
        assert f"<h2>{heading}</h2>" in page
    # Four views as pictures, renders, depths and two fields; a picture a word; two color bars.
    assert page.count("<img") == 5 * 4 + 2 * 6 + 2


def test_the_demo_gives_the_same_boxes_again(demo: Path, tmp_path: Path) -> None:
    assert cli.main(["demo", f"out={tmp_path / 'again'}", *QUICK]) == 0
    for name in ("names/boxes.json", "colors/boxes.json", "splat.ply"):
        assert (demo / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_fuse_and_localize_find_in_the_demo_room_what_the_demo_found(demo: Path, tmp_path: Path) -> None:
    features, boxes = tmp_path / "features", tmp_path / "boxes"
    table = demo / "names" / "words.safetensors"
    fused = ["fuse", str(demo / "room"), f"teacher.words={table}", f"out={features}", "quiet=true"]
    assert cli.main(fused) == 0
    results = results_of(features)
    assert results["gaussians"] == len(load_splat(demo / "splat.ply")) >= results["seen"] > 0
    assert results["views"] == 6
    truth = {thing.name: thing for thing in load_scene(demo / "room").objects if thing.placed}
    word = max(results_of(demo)["names"]["iou"].items(), key=lambda item: item[1])[0]
    assert cli.main(["localize", str(features), f"query={word}", f"out={boxes}", "pictures=1", "quiet=true"]) == 0
    best = results_of(boxes)["boxes"][0]
    thing = truth[word]
    corners = np.array(best["aabb_min"]), np.array(best["aabb_max"])
    assert aabb_iou(*corners, thing.aabb_min, thing.aabb_max) > 0.5
    assert len(list(boxes.glob("*.png"))) == 1
    assert (boxes / "boxes.ply").is_file()


def test_budgets_of_the_demo_room_are_measured_and_recorded_with_their_limits(demo: Path, tmp_path: Path) -> None:
    table, out = demo / "names" / "words.safetensors", tmp_path / "features"
    fused = ["fuse", str(demo / "room"), f"teacher.words={table}", f"out={out}", "quiet=true"]
    assert cli.main([*fused, "budget.error=0.05", "budget.megabytes=1e-3"]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert {"command", "version", "settings", "timings", "peak_memory_mb"} <= summary.keys()
    budget = summary["results"]["budget"]
    assert budget["limits"] == {"error": 0.05, "megabytes": 1e-3}
    assert 0 <= budget["measured"]["error"] <= 0.05
    size = (out / "features.safetensors").stat().st_size / 1e6
    assert budget["measured"]["megabytes"] == pytest.approx(size)
    assert budget["predicted"]["megabytes"] == pytest.approx(size, rel=0.05)
    assert summary["results"]["views"] == budget["chosen"]["views"]
    # The conflict, and the limit that it breaks.
    assert any("budget.error comes first" in line for line in summary["warnings"])
    assert any("budget.megabytes: the limit is 0.001" in line for line in summary["warnings"])


def test_evaluate_scores_the_demo_room(demo: Path, tmp_path: Path) -> None:
    table = demo / "names" / "words.safetensors"
    out = tmp_path / "scores"
    arguments = ["protocol.min_views=1", "protocol.min_pixels=1", f"out={out}", "quiet=true"]
    assert cli.main(["evaluate", str(demo / "room"), f"teacher.words={table}", *arguments]) == 0
    results = results_of(out)
    ious = list(results_of(demo)["names"]["iou"].values())
    assert results["objects"] == 6
    assert results["acc_50"] == pytest.approx(np.mean(np.array(ious) >= 0.5))
    assert results["mean_iou"] == pytest.approx(np.mean(ious), abs=1e-6)
    assert len((out / "hits.csv").read_text().splitlines()) == 7


def test_a_room_a_million_metres_away_gives_the_same_boxes_there(demo: Path, tmp_path: Path) -> None:
    shift = np.array([1e6, -2e6, 3e5])
    far = tmp_path / "far"
    shutil.copytree(demo / "room", far)
    transforms = json.loads((far / "transforms.json").read_text())
    for frame in transforms["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] += shift
        frame["transform_matrix"] = pose.tolist()
    (far / "transforms.json").write_text(json.dumps(transforms))
    boxes = {}
    for name, room in (("near", demo / "room"), ("far", far)):
        features, box_folder = tmp_path / f"{name} features", tmp_path / f"{name} boxes"
        assert cli.main(["fuse", str(room), "teacher=palette", f"out={features}", "quiet=true"]) == 0
        words = ["query=red,orange", "pictures=0", "quiet=true"]
        assert cli.main(["localize", str(features), *words, f"out={box_folder}"]) == 0
        boxes[name] = results_of(box_folder)["boxes"]
    assert len(boxes["far"]) == len(boxes["near"]) > 0
    best = [next(box for box in boxes[name] if box["query"] == "red") for name in ("near", "far")]
    corners = [np.array([box["aabb_min"], box["aabb_max"]]) for box in best]
    # Seeds fall into other cells of the grid, so boxes agree to a part of a cell and not to the bit.
    np.testing.assert_allclose(corners[1] - shift, corners[0], atol=0.01)


@pytest.mark.parametrize("wrong", ["views=0", "objects=1000", "seeds.voxel=0", "localize.threshold.fixed=2"])
def test_the_demo_refuses_what_it_cannot_do(wrong: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refusal(capsys, "demo", wrong, f"out={tmp_path / 'demo'}")
    assert wrong.split("=")[0].split(".")[-1] in line
    assert not (tmp_path / "demo").exists()
