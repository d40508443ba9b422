"""`gsencoder select`: what it writes, that this is what the library computes, and what it refuses."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_runs import refusal, results_of
from scipy.spatial.transform import Rotation
from selected_rooms import EMBEDDINGS, SPACE, read_labels, selected_room, words

from gsencoder.app import main as cli
from gsencoder.app.commands.select import LABELS_JSON, LABELS_PLY, file_stems, write_labels
from gsencoder.core.errors import InputError
from gsencoder.data.splats.files import load_property, load_splat, save_splat
from gsencoder.fusion.folder import save_features, save_memories
from gsencoder.infer.draw import word_color
from gsencoder.infer.select import Selection, find_holes, sample_views, select
from gsencoder.text.table import WORDS_FILE, TextTable, make_text_table, save_text_table
from gsencoder.types import MemoryBank, QueryMemory, Scene

SCENE, KINDS = selected_room()
HOSTILE = ("<script>alert(1)</script>", 'a "b"/../c', "\u202edrawkcab")


def stored(folder: Path, scene: Scene = SCENE, table: TextTable | None = None) -> Path:
    save_features(folder, scene, scene.features["names"], {})
    save_text_table(folder / WORDS_FILE, words() if table is None else table)
    return folder


@pytest.fixture(scope="module")
def features(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return stored(tmp_path_factory.mktemp("table") / "features")


def run(features: Path, out: Path, *arguments: str) -> None:
    assert cli.main(["select", str(features), f"out={out}", *arguments]) == 0


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_objects_and_rest_are_the_whole_scene(features: Path, tmp_path: Path) -> None:
    out = tmp_path / "selection"
    run(features, out, "query=mug,book")
    assert names_in(out) == [
        "book.ply", "holes.json", "labels.json", "labels.ply", "mug.ply", "rest.ply", "summary.json",
    ]  # fmt: skip
    labeled = read_labels(out)
    for label, name in enumerate(("rest", "mug", "book")):
        part = load_splat(out / f"{name}.ply", origin=SCENE.origin)
        rows = labeled.labels == label
        assert (part.means == labeled.gaussians.means[rows]).all()
        assert (part.sh == SCENE.gaussians.sh[rows]).all()
        assert labeled.names[label].file == f"{name}.ply"
        assert labeled.names[label].count == rows.sum() > 0
    results = results_of(out)
    assert results["views"] == 8
    assert results["selection"]["labels"] == json.loads((out / "labels.json").read_text())["labels"]
    assert [word["query"] for word in results["words"]] == ["mug", "book"]
    holes = json.loads((out / "holes.json").read_text())
    assert holes == results["holes"]
    assert holes["views"] == holes["views_with_objects"] == 8
    assert holes["pixels"] == sum(hole["pixels"] for hole in holes["by_view"])


def test_the_parts_that_are_asked_for_are_written(features, tmp_path, capsys, monkeypatch):
    run(features, tmp_path / "a", "query=mug", "write=objects", "format=spz")
    assert names_in(tmp_path / "a") == ["mug.spz", "summary.json"]
    run(features, tmp_path / "b", "query=mug", "write=rest", "format=compressed.ply", "select.views=0")
    assert names_in(tmp_path / "b") == ["rest.compressed.ply", "summary.json"]
    run(features, tmp_path / "c", "query=mug", "write=labels", "box=0")
    assert names_in(tmp_path / "c") == ["labels.json", "labels.ply", "summary.json"]
    assert [each.file for each in read_labels(tmp_path / "c").names] == [None, None]
    capsys.readouterr()
    monkeypatch.chdir(tmp_path)  # Lines are cut at 200 columns.
    assert cli.main(["select", str(features), "query=mug,lamp", "out=d"]) == 0
    mug, lamp, where = capsys.readouterr().out.splitlines()[-3:]
    assert mug.startswith("mug: ")
    assert mug.endswith("to start with, mug.ply")
    assert lamp.startswith("lamp: absent (probability")
    assert "1 object, rest.ply of " in where
    assert names_in(tmp_path / "d").count("lamp.ply") == 0


def test_packages_and_memories_are_selected_from_like_features(features: Path, tmp_path: Path) -> None:
    expected = {}
    for form in ("compact", "index"):
        packed = tmp_path / form
        assert cli.main(["pack", str(features), f"form={form}", f"out={packed}", "quiet=true"]) == 0
        expected[form] = packed
    memory = tmp_path / "memory"
    field = SCENE.features["names"]
    bank = MemoryBank(
        components=EMBEDDINGS, sources=np.zeros((4, 3), np.int32), threshold=0.9, mean=field.mean,
        grid_from_image=np.tile(np.eye(2, 3), (4, 1, 1)), coverage=1.0, cosine=1.0, space=SPACE,
    )  # fmt: skip
    queries = QueryMemory(
        queries=field.features - field.mean, weights=field.weights, projection=np.eye(8, dtype=np.float32), bank=bank,
        scoring="centered", temperature=0.1, mean=field.mean,
    )  # fmt: skip
    memory.mkdir()
    save_memories(memory, replace(SCENE, features={}), {"labels": queries})
    save_text_table(memory / WORDS_FILE, words())
    expected["memory"] = memory
    for form, folder in expected.items():
        out = tmp_path / f"{form}_selection"
        run(folder, out, "query=mug", "write=labels")
        assert ((read_labels(out).labels == 1) == (KINDS == 0)).mean() > 0.98


def test_a_bare_splat_is_selected_from_with_a_warning(tmp_path, capsys, monkeypatch):
    bare = tmp_path / "bare"
    save_features(bare, replace(SCENE, views=None), SCENE.features["names"], {})
    save_text_table(bare / WORDS_FILE, words())
    monkeypatch.setattr("gsencoder.infer.select.ORBITS", 4)
    run(bare, tmp_path / "out", "query=mug")
    assert "has no views" in capsys.readouterr().err
    assert results_of(tmp_path / "out")["placed_cameras"] is True
    assert "holes.json" not in names_in(tmp_path / "out")


def test_names_of_objects_lead_to_safe_names_of_files(tmp_path: Path) -> None:
    folder, out = tmp_path / "features", tmp_path / "out"
    save_features(folder, SCENE, SCENE.features["names"], {})
    save_text_table(folder / WORDS_FILE, make_text_table((*HOSTILE, "lamp"), EMBEDDINGS, "table"))
    (tmp_path / "queries.txt").write_text("\n".join(HOSTILE[:2]), encoding="utf-8")
    run(folder, out, f"queries={tmp_path / 'queries.txt'}", "write=[objects,labels]")
    assert names_in(out) == [
        "a_b_c.ply", "labels.json", "labels.ply", "script_alert_1_script.ply", "summary.json",
    ]  # fmt: skip
    assert [each.name for each in read_labels(out).names] == [None, *HOSTILE[:2]]
    assert names_in(tmp_path) == ["features", "out", "queries.txt"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "query= is missing"),
        (["query=mug", "box=0", "threshold=0.5"], "box= and threshold= are two ways"),
        (["query=mug", "box=3"], "box=3: 'mug' has one box, number 0"),
        (["query=mug", "threshold=-1", "select.grow=false"], "is selected, so nothing is left"),
        (["query=lamp"], "no Gaussian of table is selected; absent: 'lamp'"),
        (["query=teapot"], "teapot"),
        (["query=mug", "write=[]"], "write"),
    ],
)
def test_what_cannot_be_done_ends_in_one_line(features, tmp_path, capsys, arguments, message):
    out = tmp_path / "out"
    assert message in refusal(capsys, "select", str(features), f"out={out}", *arguments)
    assert not out.exists()


def test_seeds_and_labels_are_counted_for_each_word(features, tmp_path, capsys):
    run(features, tmp_path / "out", "query=mug,book", "threshold=0.9", "write=[objects,labels]")
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
    run(folder, tmp_path / "out", "query=mug")
    output = " ".join(capsys.readouterr().out.split())
    made = json.loads((tmp_path / "out" / "holes.json").read_text())
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
    run(folder, tmp_path / "out", "query=mug", "box=1", "write=labels", "quiet=true")
    assert ((read_labels(tmp_path / "out").labels == 1) == (KINDS == 1)).mean() > 0.99
    common = ("select", str(features), "query=mug", f"out={tmp_path / 'none'}")
    assert "no Gaussian of table is selected" in refusal(capsys, *common, "localize.min_weight=1e30")
    assert "siglip" in refusal(capsys, *common, "head=siglip")


# Files of selections: labels that read back, and names that are safe

LABELS = np.array([1, 2, 0], np.int32)[KINDS]
SELECTION = Selection(words=("mug", 'a "book"\u202e</script>'), labels=LABELS, seeds=LABELS, views=8, placed=False)


@pytest.fixture
def written(tmp_path: Path) -> Path:
    write_labels(tmp_path, SCENE, SELECTION, {1: "mug.ply"})
    return tmp_path


def test_labels_read_back_with_names_counts_and_boxes(written: Path) -> None:
    made = read_labels(written)
    assert (made.labels == LABELS).all()
    assert np.allclose(made.gaussians.means, SCENE.gaussians.means, atol=1e-6)
    assert np.allclose(made.gaussians.scales, SCENE.gaussians.scales, rtol=1e-5)
    assert (made.origin == SCENE.origin).all()
    assert [each.name for each in made.names] == [None, *SELECTION.words]
    assert [each.count for each in made.names] == np.bincount(LABELS).tolist()
    assert len({tuple(each.color) for each in made.names}) == 3
    assert [each.file for each in made.names] == [None, "mug.ply", None]
    assert made.names[0].aabb_min is None
    for each in made.names[1:]:
        members = SCENE.gaussians.means[np.flatnonzero(each.label == LABELS)] + SCENE.origin
        assert np.allclose(each.aabb_min, members.min(axis=0), atol=1e-6)
        assert np.allclose(each.aabb_max, members.max(axis=0), atol=1e-6)


def test_the_labeled_splat_is_a_splat_for_every_other_reader(written: Path) -> None:
    save_splat(written / "plain.ply", SCENE.gaussians, origin=SCENE.origin)
    plain, labeled = (load_splat(written / name, origin=SCENE.origin) for name in ("plain.ply", LABELS_PLY))
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert (getattr(plain, name) == getattr(labeled, name)).all()
    trimesh = pytest.importorskip("trimesh")
    assert np.allclose(trimesh.load(written / LABELS_PLY).vertices - SCENE.origin, plain.means, atol=1e-4)


def test_boxes_hold_their_gaussians_stand_upright_and_have_the_colors_of_boxes(tmp_path: Path) -> None:
    """The scene is tilted, so that none of the axes of the world is upward."""
    turn = Rotation.from_euler("zyx", [30, 25, 10], degrees=True)
    turned = replace(SCENE.gaussians, means=turn.apply(SCENE.gaussians.means).astype(np.float32))
    up = turn.apply([0.0, 0.0, 1.0])
    scene = replace(SCENE, gaussians=turned, up=up)
    write_labels(tmp_path, scene, SELECTION, {0: "rest.ply", 1: "mug.ply"})
    rest, *named = json.loads((tmp_path / LABELS_JSON).read_text())["labels"]
    assert rest["file"] == "rest.ply"
    assert rest["obb"] is None
    for number, row in enumerate(named):
        box = row["obb"]
        members = turned.means[number + 1 == LABELS] + SCENE.origin
        along = (members - box["center"]) @ np.array(box["rotation"])
        np.testing.assert_allclose(along.max(axis=0), np.array(box["size"]) / 2, atol=1e-5)
        np.testing.assert_allclose(along.min(axis=0), -np.array(box["size"]) / 2, atol=1e-5)
        np.testing.assert_allclose(np.array(box["rotation"])[:, 2], up, atol=1e-6)
        assert row["color"] == list(word_color(number))


def test_words_without_gaussians_have_a_count_of_zero_and_no_box(tmp_path: Path) -> None:
    write_labels(tmp_path, SCENE, replace(SELECTION, words=("mug", "book", "lamp")), {})
    lamp = read_labels(tmp_path).names[3]
    assert (lamp.name, lamp.count, lamp.aabb_min, lamp.aabb_max) == ("lamp", 0, None, None)


def test_missing_files_and_properties_are_refused(written: Path) -> None:
    save_splat(written / LABELS_PLY, SCENE.gaussians, origin=SCENE.origin)
    with pytest.raises(InputError, match="has no property 'label'"):
        load_property(written / LABELS_PLY, "label")
    (written / LABELS_PLY).unlink()
    with pytest.raises(InputError, match=LABELS_PLY):
        load_property(written / LABELS_PLY, "label")
    (written / "a.spz").write_bytes(b"NGSP" + bytes(60))
    with pytest.raises(InputError, match="not a .ply file"):
        load_property(written / "a.spz", "label")


def test_properties_of_text_and_truncated_files_are_read_or_refused(written: Path, tmp_path: Path) -> None:
    text = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float label\nend_header\n0 1\n5 2\n"
    (tmp_path / "text.ply").write_text(text)
    assert load_property(tmp_path / "text.ply", "label").tolist() == [1, 2]
    whole = (written / LABELS_PLY).read_bytes()
    (tmp_path / "cut.ply").write_bytes(whole[:-10])
    with pytest.raises(InputError, match="truncated"):
        load_property(tmp_path / "cut.ply", "label")


@pytest.mark.parametrize(
    ("word", "stem"),
    [
        ("mug", "mug"),
        ("coffee table", "coffee_table"),
        ("../../etc/passwd", "etc_passwd"),
        ("<script>alert('x')</script>", "script_alert_x_script"),
        ("\u202egnp.exe", "gnp_exe"),
        ("杯子", "杯子"),
        ("Cafe\u0301", "Café"),
        ("\0\n\t", "object"),
        ("\udcff", "object"),
        ("CON", "CON_2"),
        ("LPT9", "LPT9_2"),
        ("\uff23\uff2f\uff2e", "CON_2"),  # wide letters
        ("rest", "rest_2"),
        ("C:\\mug", "C_mug"),
        ("x" * 500, "x" * 60),
        ("x" * 59 + " mug", "x" * 59),
        ("杯" * 50, "杯" * 20),
    ],
)
def test_names_of_files_keep_letters_and_nothing_else(word: str, stem: str) -> None:
    assert file_stems([word], taken=("rest", "labels")) == [stem]


def test_names_of_files_differ_in_any_case_of_letters() -> None:
    stems = file_stems(["Mug", "mug", "mug!", "mug_2", "rest"], taken=("rest",))
    assert stems == ["Mug", "mug_2", "mug_3", "mug_2_2", "rest_2"]
    assert len({stem.casefold() for stem in stems}) == len(stems)
    long = file_stems(["a" * 80, "a" * 90])
    assert long == ["a" * 60, "a" * 60 + "_2"]
