import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scene_files import photograph, world_from_cams, write_colmap

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.colmap import CAMERA_PARAMS, read_colmap
from gsencoder.data.readers.posed import load_pycolmap
from gsencoder.data.scenes import load_scene

FILES = ["cameras.bin", "images.bin", "points3D.bin"]


@pytest.mark.parametrize(("text", "old"), [(False, False), (False, True), (True, False), (True, True)])
def test_every_kind_of_a_model_gives_the_same_scene(tmp_path, text, old):
    write_colmap(tmp_path, text=text, old=old)
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


def test_distorted_models_are_undistorted_once_a_camera(tmp_path):
    write_colmap(tmp_path, model="SIMPLE_RADIAL", params=(30, 16, 12, 0.2))
    views = load_scene(tmp_path).views
    assert views.masks is None
    assert 30 < views.cameras.Ks[0, 0, 0] < 30 * 1.3
    assert not (views.images[0] == photograph(1)).all()


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
@pytest.mark.parametrize("count", [2**20, 2**64 - 1])
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


def test_the_parameter_counts_are_those_of_pycolmap():
    pycolmap = load_pycolmap()
    for number, (name, count) in enumerate(CAMERA_PARAMS.items()):
        made = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(number), 1.0, 1, 1)
        assert (made.model.name, len(made.params)) == (name, count)


def test_pictures_can_be_written_after_pycolmap_came_in():
    """pycolmap's zlib and the system's must not meet (see load_pycolmap): the process would abort."""
    code = (
        "from gsencoder.data.readers.posed import load_pycolmap; load_pycolmap(); "
        "import io, zlib; from PIL import Image; "
        "Image.new('RGB', (64, 48)).save(io.BytesIO(), 'PNG'); print(len(zlib.compress(b'a' * 1000)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 100


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(
    ("first", "problem"),
    [("0", r"its quaternion .{}. has length 0, expected 1"), ("nan", "values that are not finite")],
)
def test_a_quaternion_of_no_rotation_is_refused_with_its_image_and_file(tmp_path, text, first, problem):
    name = "images.txt" if text else "images.bin"
    spoil(write_colmap(tmp_path, text=text) / name, f"{first} 0 0 0")
    with pytest.raises(InputError, match=rf"image '001\.png': .*{problem.format(name)}"):
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


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("cameras", lambda lines: lines[1:], r"cameras\.txt: announces 1 entries and holds 0"),
        ("cameras", lambda lines: [lines[0][:9]], r"cameras\.txt: line 4 is not CAMERA_ID MODEL"),
        ("cameras", lambda lines: [lines[0].replace("PIN", "pin")], r"camera 1: camera model pinHOLE is not"),
        ("images", lambda lines: lines[1:], r"images\.txt: line 5 is not IMAGE_ID QW"),
        ("images", lambda lines: [lines[0], "nan 1 -1 " + lines[1], *lines[2:]], r"images\.txt: line 6 is not IM"),
        ("images", lambda lines: lines[:4], r"images\.txt: announces 3 entries and holds 2"),
        ("points3D", lambda lines: [*lines[:2], *lines[3:]], r"points3D\.txt: announces 5 entries and holds 4"),
        ("points3D", lambda lines: [*lines[:4], lines[4][:20]], r"points3D\.txt: line 8 is not POINT3D_ID X Y Z"),
    ],
)
def test_a_line_that_is_lost_or_damaged_is_named_with_its_file(tmp_path, name, damage, message):
    path = write_colmap(tmp_path, text=True) / f"{name}.txt"
    lines = path.read_text().splitlines()
    start = next(row for row, line in enumerate(lines) if not line.startswith("#"))
    path.write_text("\n".join([*lines[:start], *damage(lines[start:])]) + "\n")
    with pytest.raises(InputError, match=message):
        load_scene(tmp_path)
