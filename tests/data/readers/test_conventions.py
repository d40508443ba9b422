"""What a scene names or carries by convention is read, and what is not used is listed."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from field_scenes import FieldRoom, with_fields, write_colmap_text, write_ply, write_transforms
from PIL import Image

from gsencoder.app.commands.inspect import scene_facts
from gsencoder.app.main import main
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.transforms_json import transforms_of
from gsencoder.data.scenes import SceneConfig, load_scene, read_posed
from gsencoder.data.seeding.seed import choose_source, seed
from gsencoder.data.splats.files import load_splat, read_raw
from gsencoder.data.splats.ply import opacities_from_logits
from gsencoder.data.splats.repair import inspect_splat

MASK = np.full((120, 160), 255, np.uint8)
MASK[60:, 80:] = 0


def save_mask(path: Path, pixels: np.ndarray = MASK) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def masks_of(folder: Path, **options: Any) -> list[np.ndarray] | None:
    views = load_scene(folder, options=SceneConfig(**options)).views
    return None if views.masks is None else [np.asarray(mask) for mask in views.masks]


def unused_of(folder: Path) -> tuple[str, ...]:
    scene = load_scene(folder)
    posed, _, layout = read_posed(folder.absolute())
    return tuple(scene_facts(scene, posed, layout, None)["unused"])


@pytest.mark.parametrize("shrink", [1, 2])
def test_masks_beside_the_images_of_a_colmap_scene_are_read(field_room, tmp_path, shrink):
    folder = write_colmap_text(tmp_path, field_room.copy_photographs(tmp_path))
    for image in (folder / "images").iterdir():
        save_mask(folder / "masks" / f"{image.name}.png", MASK[::shrink, ::shrink])
    masks = masks_of(folder)
    assert all(np.array_equal(mask, MASK > 0) for mask in masks)
    assert unused_of(folder) == ()
    # Photographs elsewhere, as the command reconstruct has them, keep the masks of the scene.
    (folder / "images").rename(folder / "pictures")
    assert masks_of(folder, images=str(folder / "pictures")) is not None


def test_masks_follow_the_folders_of_the_images(field_room, tmp_path):
    content = field_room.copy_photographs(tmp_path)
    names = []
    for number, frame in enumerate(content["frames"]):
        name = f"camera_{number % 2}/{Path(frame['file_path']).name}"
        (tmp_path / "images" / name).parent.mkdir(exist_ok=True)
        (tmp_path / frame["file_path"]).rename(tmp_path / "images" / name)
        names.append(name)
    for name in names:
        save_mask(tmp_path / "masks" / f"{name}.png")
    masks = masks_of(write_colmap_text(tmp_path, content, names=names))
    assert not any(mask.all() for mask in masks)


def test_a_mask_may_have_png_in_place_of_the_ending_and_missing_ones_are_counted(field_room, tmp_path):
    content = field_room.copy_photographs(tmp_path)
    folder = write_colmap_text(tmp_path, content)
    for image in sorted((folder / "images").iterdir())[:3]:
        save_mask(folder / "masks" / f"{image.stem}.png")
    with pytest.warns(SceneWarning, match="5 of 8 masks are missing .*all pixels of those views are used"):
        masks = masks_of(folder)
    assert [mask.all() for mask in masks] == [False] * 3 + [True] * 5


def points_of(field_room: FieldRoom, **changes: np.ndarray) -> np.ndarray:
    rows = field_room.rows()[::22]
    colors = np.clip(0.5 + 0.2821 * np.stack([rows[f"f_dc_{i}"] for i in range(3)], axis=1), 0, 1)
    names = [name for name in rows.dtype.names or () if name not in "xyz"]
    tints = {name: (255 * colors[:, i]).astype(np.uint8) for i, name in enumerate(("red", "green", "blue"))}
    return with_fields(rows, names, **(tints | changes))


def test_points_that_a_transforms_json_names_are_the_scenes_and_make_its_seeds(field_room, tmp_path):
    content = {**field_room.copy_photographs(tmp_path), "ply_file_path": "points/sparse_pc.ply"}
    (tmp_path / "points").mkdir()
    points = points_of(field_room)
    write_ply(tmp_path / "points/sparse_pc.ply", points)
    folder = write_transforms(tmp_path, content)
    scene = load_scene(folder)
    assert np.array_equal(scene.sfm_points[:, 2], points["z"])
    assert np.array_equal(scene.sfm_colors[:, 1], points["green"])
    assert choose_source(scene) == "points"
    assert unused_of(folder) == ()
    with pytest.warns(SceneWarning, match="unit of scene"):
        assert len(seed(scene)) > len(points) / 2
    # `repair` writes the scene again with its points.
    posed = read_posed(folder)[0]
    assert transforms_of(posed, folder)["ply_file_path"] == "points/sparse_pc.ply"


def test_colors_of_points_may_be_shares_or_missing_and_points_that_are_not_finite_are_left_out(field_room, tmp_path):
    content = {**field_room.copy_photographs(tmp_path), "ply_file_path": "points.ply"}
    points = points_of(field_room)
    x = points["x"].copy()
    x[3] = np.nan
    shares = {name: (points[name] / 255).astype(np.float32) for name in ("red", "green", "blue")}
    write_ply(tmp_path / "points.ply", points_of(field_room, x=x, **shares))
    folder = write_transforms(tmp_path, content)
    with pytest.warns(SceneWarning, match="1 of [0-9]+ points are not finite"):
        scene = load_scene(folder)
    assert np.array_equal(scene.sfm_colors[:, 0], np.delete(points["red"], 3))
    write_ply(tmp_path / "points.ply", with_fields(points, ("red", "green", "blue")))
    scene = load_scene(folder)
    assert scene.sfm_points is not None
    assert scene.sfm_colors is None


@pytest.mark.parametrize(
    ("name", "problem"), [("../points.ply", "leads out"), (7, "must be a path"), ("mesh.ply", "not a .ply")]
)
def test_points_that_cannot_be_used_are_refused(name, problem, field_room, tmp_path):
    folder = tmp_path / "scene"
    content = {**field_room.copy_photographs(folder), "ply_file_path": name}
    (folder / "mesh.ply").write_bytes(b"no points")
    with pytest.raises(InputError, match=problem):
        load_scene(write_transforms(folder, content))


def test_the_filter_of_mip_splatting_is_applied_row_by_row(field_room, tmp_path):
    rows = field_room.rows()
    widths = np.random.default_rng(0).uniform(0, 0.02, len(rows)).astype(np.float32)
    widths[::7] = 0
    path = write_ply(tmp_path / "filtered.ply", with_fields(rows, filter_3D=widths))
    with pytest.warns(SceneWarning, match="filter_3D of mip-splatting is applied"):
        filtered = load_splat(path)
    plain = load_splat(field_room.splat)
    squares = plain.scales.astype(np.float64) ** 2
    wider = squares + widths.astype(np.float64)[:, None] ** 2
    assert np.allclose(filtered.scales, np.sqrt(wider), rtol=1e-5)
    fainter = plain.opacities * np.sqrt(squares.prod(axis=1) / wider.prod(axis=1))
    assert np.allclose(filtered.opacities, fainter, rtol=1e-4, atol=1e-7)
    assert np.allclose(filtered.opacities[::7], plain.opacities[::7], atol=1e-6)
    assert np.array_equal(filtered.means, plain.means)


@pytest.mark.parametrize("width", [-0.01, np.nan])
def test_a_filter_that_is_no_width_is_named(field_room, tmp_path, width):
    rows = field_room.rows()
    widths = np.zeros(len(rows), np.float32)
    widths[3:5] = width
    path = write_ply(tmp_path / "filtered.ply", with_fields(rows, filter_3D=widths))
    with pytest.raises(InputError, match="filter_3D of 2 rows is no width"):
        load_splat(path)


def test_inspect_says_that_the_filter_is_applied_and_lists_other_properties_once(field_room, tmp_path):
    rows = field_room.rows()
    column = np.full(len(rows), 0.005, np.float32)
    path = write_ply(tmp_path / "filtered.ply", with_fields(rows, filter_3D=column, semantic_0=column))
    with pytest.warns(SceneWarning, match="filter_3D"):
        raw = read_raw(path)
    report = inspect_splat(raw)
    assert raw.format.endswith("filter_3D applied")
    assert report.unused == ("property semantic_0",)
    before = opacities_from_logits(read_raw(field_room.splat).logit_opacities)
    assert report.opacity_quantiles["0.5"] < np.median(before)
    # Normals of zeros, which trainers write, are nothing to speak of.
    assert inspect_splat(read_raw(field_room.splat)).unused == ()


def test_inspect_lists_every_key_and_folder_that_was_not_used(field_room, tmp_path, capsys):
    folder = tmp_path / "room"
    content = field_room.copy_photographs(folder, depth=True)
    assert unused_of(write_transforms(folder, content)) == ()
    content.update(aabb_scale=4, applied_transform=np.eye(4)[:3].tolist())
    for frame in content["frames"]:
        frame["sharpness"] = 20.0
    for name in ("images_2", "depths", ".cache"):
        (folder / name).mkdir()
    write_transforms(folder, content)
    expected = (
        "key aabb_scale of transforms.json",
        "key applied_transform of transforms.json",
        "key sharpness of the frames of transforms.json",
        "folder depths",
        "folder images_2",
    )
    assert unused_of(folder) == expected
    out = tmp_path / "facts"
    assert main(["inspect", str(folder), "check=false", f"out={out}"]) == 0
    assert capsys.readouterr().out.count("sharpness") == 1
    assert json.loads((out / "summary.json").read_text())["results"]["scenes"][0]["unused"] == list(expected)


def test_a_distortion_that_nothing_here_reads_is_refused(field_room, tmp_path):
    content = {**field_room.copy_photographs(tmp_path), "k5": 0.0}
    load_scene(write_transforms(tmp_path, content))
    with pytest.raises(InputError, match="k6 of a perspective camera"):
        load_scene(write_transforms(tmp_path, {**content, "k6": 0.1}))
