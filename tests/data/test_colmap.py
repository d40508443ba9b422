import shutil
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scene_files import photograph, save, world_from_cams, write_colmap

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.colmap import CAMERA_PARAMS, read_colmap
from gsencoder.data.readers.undistort import load_pycolmap
from gsencoder.data.scenes import SceneConfig, load_scene

FILES = ["cameras.bin", "images.bin", "points3D.bin"]


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("where", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_every_kind_and_place_of_a_model_gives_the_same_scene(tmp_path, text, old, where):
    write_colmap(tmp_path, text=text, old=old, where=where)
    scene = load_scene(tmp_path)
    assert scene.views.names == ("001.png", "002.png", "003.png")
    assert np.abs(scene.views.cameras.cam_from_world - np.linalg.inv(world_from_cams(3))).max() < 1e-6
    assert np.abs(scene.views.cameras.Ks[0] - [[30, 0, 16], [0, 31, 12], [0, 0, 1]]).max() < 1e-6
    order = np.argsort(scene.sfm_colors[:, 0])
    wanted = np.random.default_rng(0).uniform(-0.3, 0.3, (5, 3))
    assert np.abs(scene.sfm_points[order] - wanted).max() < 1e-6
    assert scene.sfm_colors[order, 0].tolist() == [0, 10, 20, 30, 40]
    assert scene.metres_per_unit is None
    assert scene.up is None


def test_a_model_given_itself_finds_its_photographs(tmp_path):
    sparse = write_colmap(tmp_path)
    assert len(load_scene(sparse).views or ()) == 3
    assert load_scene(sparse).name == load_scene(tmp_path).name == tmp_path.name
    (tmp_path / "images").rename(tmp_path / "photos")
    with pytest.raises(InputError, match=r"looked for .*images.*say images="):
        load_scene(tmp_path)
    assert len(load_scene(tmp_path, options=SceneConfig(images="photos")).views or ()) == 3
    with pytest.raises(InputError, match="images=none: no such folder"):
        load_scene(tmp_path, options=SceneConfig(images="none"))


def test_distorted_models_are_undistorted_once_a_camera(tmp_path):
    write_colmap(tmp_path, model="SIMPLE_RADIAL", params=(30, 16, 12, 0.2))
    views = load_scene(tmp_path).views
    assert views.masks is None
    assert 30 < views.cameras.Ks[0, 0, 0] < 30 * 1.3
    assert not (views.images[0] == photograph(1)).all()
    assert len(views.images._remaps._remaps) == 1  # type: ignore[attr-defined]


def test_a_model_that_is_no_pinhole_is_a_named_error(tmp_path):
    sparse = write_colmap(tmp_path, model="OPENCV", params=(30, 31, 16, 12, 0, 0, 0, 0))
    text = tmp_path / "text"
    text.mkdir()
    load_pycolmap().Reconstruction(str(sparse)).write_text(str(text))
    cameras = (text / "cameras.txt").read_text().splitlines()
    cameras[-1] = "1 EQUIRECTANGULAR 32 24 32 24"
    (text / "cameras.txt").write_text("\n".join(cameras) + "\n")
    with pytest.raises(InputError, match="camera 1: camera model EQUIRECTANGULAR"):
        read_colmap(text, tmp_path / "images", tmp_path)


def test_missing_photographs_are_counted_once(tmp_path):
    write_colmap(tmp_path, 4)
    for name in ("001.png", "004.png"):
        (tmp_path / "images" / name).unlink()
    with pytest.warns(SceneWarning, match=r"2 of 4 images of the model are missing \(first: '001.png'\)") as caught:
        views = load_scene(tmp_path).views
    assert len(caught) == 1
    assert views.names == ("002.png", "003.png")
    for path in (tmp_path / "images").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="no view: of 4 images 4 are not in"):
        load_scene(tmp_path)


def test_a_photograph_of_another_size_is_an_error(tmp_path):
    write_colmap(tmp_path)
    save(tmp_path / "images/002.png", photograph(0, 16, 12))
    with pytest.raises(InputError, match=r"002\.png has 16×12 pixels but its camera 32×24"):
        load_scene(tmp_path)


def test_names_that_leave_the_scene_are_refused(tmp_path):
    sparse = write_colmap(tmp_path / "scene", text=True)
    outside = save(tmp_path / "x.png", photograph(0))
    images = sparse / "images.txt"
    images.write_text(images.read_text().replace("001.png", "../../x.png"))
    with pytest.raises(InputError, match="leads out of the scene folder"):
        load_scene(tmp_path / "scene")
    views = load_scene(tmp_path / "scene", options=SceneConfig(allow_outside=True)).views
    assert "../../x.png" in views.names
    assert outside.is_file()


def test_several_models_are_named(tmp_path):
    write_colmap(tmp_path)
    write_colmap(tmp_path, where="sparse/1")
    with pytest.warns(SceneWarning, match="holds 2 models; 0 is used"):
        load_scene(tmp_path)


@pytest.mark.parametrize("name", FILES)
def test_every_truncation_of_a_binary_file_names_it_and_the_missing_bytes(tmp_path, name):
    sparse = write_colmap(tmp_path)
    data = (sparse / name).read_bytes()
    for size in range(len(data)):
        (sparse / name).write_bytes(data[:size])
        with pytest.raises(InputError, match=name):
            read_colmap(sparse, tmp_path / "images", tmp_path)
    (sparse / name).write_bytes(data + b"\0")
    with pytest.raises(InputError, match="1 bytes follow the last record"):
        load_scene(tmp_path)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("count", [2**20, 2**40, 2**63, 2**64 - 1])
def test_a_huge_claimed_count_is_refused_before_memory_is_asked_for(tmp_path, name, count):
    sparse = write_colmap(tmp_path)
    data = (sparse / name).read_bytes()
    (sparse / name).write_bytes(struct.pack("<Q", count) + data[8:])
    with pytest.raises(InputError, match=f"{name}: announces {count}"):
        load_scene(tmp_path)


def test_a_missing_file_of_a_model_is_named(tmp_path):
    for text, name in ((False, "points3D.bin"), (True, "points3D.txt"), (False, "images.bin")):
        sparse = write_colmap(tmp_path / name, text=text)
        (sparse / name).unlink()
        with pytest.raises(InputError, match=f"{name} is missing"):
            load_scene(tmp_path / name)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_text_file_that_lost_its_last_lines_is_an_error(tmp_path, name):
    sparse = write_colmap(tmp_path, text=True)
    path = sparse / f"{name}.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[: -2 if name == "images" else -1]) + "\n")
    with pytest.raises(InputError, match=f"{name}|pycolmap"):
        load_scene(tmp_path)


@pytest.mark.parametrize("announced", [4, 6])
def test_a_text_file_holds_as_many_entries_as_it_announces(tmp_path, announced):
    path = write_colmap(tmp_path, text=True) / "points3D.txt"
    text = path.read_text()
    assert "# Number of points: 5" in text
    path.write_text(text.replace("# Number of points: 5", f"# Number of points: {announced}"))
    with pytest.raises(InputError, match=rf"points3D\.txt: announces {announced} entries and holds 5"):
        load_scene(tmp_path)


def test_the_parameter_counts_are_those_of_pycolmap():
    pycolmap = load_pycolmap()
    for number, (name, count) in enumerate(CAMERA_PARAMS.items()):
        made = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(number), 1.0, 1, 1)
        assert (made.model.name, len(made.params)) == (name, count)


def test_pictures_can_be_written_after_pycolmap_came_in():
    """pycolmap's zlib and the system's must not meet (see load_pycolmap): the process would abort."""
    code = (
        "from gsencoder.data.readers.undistort import load_pycolmap; load_pycolmap(); "
        "import io, zlib; from PIL import Image; "
        "Image.new('RGB', (64, 48)).save(io.BytesIO(), 'PNG'); print(len(zlib.compress(b'a' * 1000)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 100


@pytest.mark.filterwarnings("ignore::gsencoder.core.errors.SceneWarning")
@pytest.mark.parametrize("text", [False, True])
@pytest.mark.slow
def test_mutated_models_give_a_scene_or_an_input_error(tmp_path, text):
    source = write_colmap(tmp_path, model="OPENCV", params=(30, 31, 16, 12, 0.01, 0, 0, 0), text=text)
    original = {path.name: path.read_bytes() for path in source.iterdir()}
    outcomes = []

    @settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.nested_given])
    @given(data=st.data())
    def mutate(data):
        shutil.rmtree(source)
        source.mkdir()
        for name, content in original.items():
            (source / name).write_bytes(content)
        name = data.draw(st.sampled_from(sorted(original)))
        content = bytearray(original[name])
        for _ in range(data.draw(st.integers(1, 3))):
            at = data.draw(st.integers(0, len(content)))
            new = data.draw(st.binary(max_size=8) | st.sampled_from([b"\xff" * 8, b"nan ", b"1e999 ", b"-1 "]))
            content[at : at + data.draw(st.integers(0, 8))] = new
        (source / name).write_bytes(bytes(content))
        try:
            scene = load_scene(tmp_path)
        except InputError as error:
            outcomes.append(str(error))
        else:
            outcomes.append("")
            assert np.isfinite(scene.views.cameras.cam_from_world).all()

    mutate()
    assert not any("\n" in message for message in outcomes)
    assert any(outcomes)


@pytest.mark.shared
def test_the_plush_reprojects_after_undistortion_as_its_model_does(shared):
    scene = load_scene(shared / "scenes/plush")
    views = scene.views
    assert len(views) == 97
    assert views.masks is None
    model = load_pycolmap().Reconstruction(str(shared / "scenes/plush/sparse"))
    rows = {name: row for row, name in enumerate(views.names)}
    camera = next(iter(model.cameras.values()))
    zoom = float(views.cameras.Ks[0, 0, 0]) / camera.params[0]
    ours, theirs = [], []
    for image in model.images.values():
        seen = [point for point in image.points2D if point.has_point3D()]
        if not seen:
            continue
        pixels = np.array([point.xy for point in seen])
        points = np.array([model.points3D[point.point3D_id].xyz for point in seen])
        k = views.cameras.Ks[rows[image.name]].astype(float)
        pose = views.cameras.cam_from_world[rows[image.name]].astype(float)
        local = (points - scene.origin) @ pose[:3, :3].T + pose[:3, 3]
        straight = camera.cam_from_img(pixels) * (k[0, 0], k[1, 1]) + k[:2, 2]
        ours.append(np.linalg.norm((local @ k.T)[:, :2] / local[:, 2:] - straight, axis=1) / zoom)
        exact = image.cam_from_world().matrix()
        theirs.append(np.linalg.norm(camera.img_from_cam(points @ exact[:, :3].T + exact[:, 3]) - pixels, axis=1))
    assert np.concatenate(ours).mean() < 1.02 * np.concatenate(theirs).mean()
    assert np.concatenate(theirs).mean() < 0.8


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("old", [False, True])
def test_a_quaternion_of_no_rotation_is_refused_with_its_image_and_file(tmp_path, text, old):
    sparse = write_colmap(tmp_path, text=text, old=old)
    name = "images.txt" if text else "images.bin"
    spoil(sparse / name, "0 0 0 0")
    with pytest.raises(InputError, match=rf"image '001\.png': its quaternion .{name}. has length 0, expected 1"):
        load_scene(tmp_path)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("value", ["nan", "inf"])
def test_a_quaternion_that_is_not_finite_is_refused_with_its_image(tmp_path, text, value):
    sparse = write_colmap(tmp_path, text=text, old=True)
    spoil(sparse / ("images.txt" if text else "images.bin"), f"{value} 0 0 0")
    with pytest.raises(InputError, match=r"image '001\.png': the pose has values that are not finite"):
        load_scene(tmp_path)


def spoil(file: Path, quaternion: str) -> None:
    """Gives the first pose of a file another quaternion."""
    if file.suffix == ".bin":
        data = bytearray(file.read_bytes())
        struct.pack_into("<4d", data, 12, *map(float, quaternion.split()))
        file.write_bytes(data)
        return
    lines = file.read_text().splitlines()
    row = next(number for number, line in enumerate(lines) if not line.startswith("#"))
    words = lines[row].split()
    words[1:5] = quaternion.split()
    lines[row] = " ".join(words)
    file.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("text", [False, True])
def test_a_name_longer_than_any_file_has_is_refused_at_once(tmp_path, text):
    sparse = write_colmap(tmp_path, text=text, old=True)
    file = sparse / ("images.txt" if text else "images.bin")
    file.write_bytes(file.read_bytes().replace(b"002.png", b"a/" * 500_000 + b"2.png"))
    begun = time.monotonic()
    with pytest.raises(InputError, match="is not a path .1,000,005 characters, at most 4,096.") as caught:
        load_scene(tmp_path)
    assert time.monotonic() - begun < 10
    assert len(str(caught.value)) < 1000


def drop(lines: list[str], row: int) -> list[str]:
    return lines[:row] + lines[row + 1 :]


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("cameras", lambda lines: drop(lines, 0), r"cameras\.txt: announces 1 entries and holds 0"),
        ("cameras", lambda lines: [lines[0][:9]], r"cameras\.txt: line 4 is not CAMERA_ID MODEL"),
        ("cameras", lambda lines: [lines[0].rsplit(" ", 1)[0]], r"cameras\.txt: line 4 is not CAMERA_ID MODEL"),
        ("cameras", lambda lines: [lines[0].replace("PIN", "pin")], r"camera 1: camera model pinHOLE cannot be"),
        ("images", lambda lines: drop(lines, 0), r"images\.txt: line 5 is not IMAGE_ID QW"),
        (
            "images",
            lambda lines: [lines[0], "nan 1 -1 " + lines[1], *lines[2:]],
            r"images\.txt: line 6 is not IMAGE_ID",
        ),
        ("images", lambda lines: drop(lines, 2), r"images\.txt: line 7 is not IMAGE_ID QW"),
        ("images", lambda lines: lines[:4], r"images\.txt: announces 3 entries and holds 2"),
        ("points3D", lambda lines: drop(lines, 2), r"points3D\.txt: announces 5 entries and holds 4"),
        ("points3D", lambda lines: [*lines[:4], lines[4][:20]], r"points3D\.txt: line 8 is not POINT3D_ID X Y Z"),
        ("points3D", lambda lines: ["a" + lines[0], *lines[1:]], r"points3D\.txt: line 4 is not POINT3D_ID X Y Z"),
    ],
)
def test_a_line_that_is_lost_or_damaged_is_named_with_its_file(tmp_path, old, name, damage, message):
    path = write_colmap(tmp_path, text=True, old=old) / f"{name}.txt"
    lines = path.read_text().splitlines()
    start = next(row for row, line in enumerate(lines) if not line.startswith("#"))
    path.write_text("\n".join([*lines[:start], *damage(lines[start:])]) + "\n")
    with pytest.raises(InputError, match=message):
        load_scene(tmp_path)
