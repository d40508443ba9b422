"""Label images: what is read of which kind of file, and how their pixels become those of the view."""

import numpy as np
import pytest
from region_scenes import HEIGHT, WIDTH, region_scene
from safetensors.numpy import save_file
from scene_files import photograph, save, write_colmap, write_transforms

from gsencoder.core.errors import InputError
from gsencoder.data.readers.masks import label_files, read_labels
from gsencoder.data.scenes import SceneConfig, load_scene

LABELS = np.array([[0, 1, 2], [300, 0, 7]])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int32, np.uint64])
def test_a_png_holds_labels_of_8_or_16_bits_and_arrays_any_integers(tmp_path, dtype):
    values = (LABELS % 256).astype(dtype)
    np.save(tmp_path / "m.npy", values)
    save_file({"anything": values}, tmp_path / "m.safetensors")
    if dtype in (np.uint8, np.uint16):
        save(tmp_path / "m.png", values)
    for path in tmp_path.iterdir():
        assert read_labels(path).dtype == np.int32
        np.testing.assert_array_equal(read_labels(path), values)


@pytest.mark.parametrize(
    ("name", "write", "problem"),
    [
        ("m.png", lambda p: save(p, photograph(0)), "must be a 8- or 16-bit picture with one channel, got mode RGB"),
        ("m.jpg", lambda p: save(p, LABELS.astype(np.uint8)), "expected a label image as .png, .npy, .safetensors"),
        ("m.npy", lambda p: np.save(p, LABELS / 2), "labels as integers, one a pixel and 0 = none, got float64"),
        ("m.npy", lambda p: np.save(p, LABELS - 1), "expected labels from 0"),
        ("m.npy", lambda p: np.save(p, photograph(0)), r"expected an array \[H, W\], got \[24, 32, 3\]"),
        ("m.npy", lambda p: np.save(p, np.array([{"a": 1}], object)), "not a readable .npy array"),
        ("m.safetensors", lambda p: p.write_bytes(b"no"), "cannot be read as .safetensors"),
        ("m.safetensors", lambda p: save_file({"a": LABELS, "b": LABELS}, p), "expected one array .*, got 2 arrays"),
    ],
)
def test_other_files_are_refused_in_one_line(tmp_path, name, write, problem):
    write(tmp_path / name)  # type: ignore[operator]
    with pytest.raises(InputError, match=problem) as caught:
        read_labels(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_labels_have_the_size_of_the_photograph(tmp_path):
    path = save(tmp_path / "m.png", np.ones((HEIGHT, WIDTH + 1), np.uint8))
    views = region_scene().views
    with pytest.raises(InputError, match="33×24 pixels, expected 32×24"):
        label_files([path] * 2, views)[0]


def test_labels_are_scaled_with_the_photographs_and_follow_selected_views(tmp_path):
    write_transforms(tmp_path, count=3)
    paths = [save(tmp_path / f"masks/{view}.png", np.full((24, 32), view + 1, np.uint8)) for view in range(3)]
    scene = load_scene(tmp_path, options=SceneConfig(image_scale=0.5))
    files = label_files([paths[2], paths[0]], scene.views.select([2, 0]).select([0, 1]))
    for labels, value in zip(files, (3, 1), strict=True):
        np.testing.assert_array_equal(labels, np.full((12, 16), value))


def test_labels_are_undistorted_with_the_photographs(tmp_path):
    write_colmap(tmp_path, model="SIMPLE_RADIAL", params=(30.0, 16.0, 12.0, 0.3))
    scene = load_scene(tmp_path)
    paths = []
    for view in range(len(scene.views)):
        dots = np.zeros((24, 32), np.uint8)
        dots[::4, ::4] = 255
        save(tmp_path / "images" / scene.views.names[view], np.repeat(dots[..., None], 3, axis=2))
        paths.append(save(tmp_path / f"{view}.png", dots))
    labels = label_files(paths, scene.views)[0]
    photo = scene.views.images[0][..., 0]
    assert 10 < (labels > 0).sum() < 24 * 32 / 8
    # A pixel that took a dot as its nearest one has at least a quarter of it in its bilinear mean.
    assert (photo[labels > 0] >= 255 / 4 - 2).all()
    assert (photo[labels == 0] <= 255 * 3 / 4 + 2).all()
