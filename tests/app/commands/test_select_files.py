"""Files of selections: labels that read back, and names that are safe."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from selected_rooms import read_labels, selected_room

from gsencoder.app.commands.select import LABELS_JSON, LABELS_PLY, file_stems, write_labels
from gsencoder.core.errors import InputError
from gsencoder.data.splats.files import load_property, load_splat, save_splat
from gsencoder.infer.draw import word_color
from gsencoder.infer.select import Selection

SCENE, KINDS = selected_room()
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
