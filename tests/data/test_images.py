"""Photographs: sizes, formats, bombs; and how distorted ones become pinhole views."""

import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scene_files import photograph, save, with_depth

from gsencoder.core.errors import InputError
from gsencoder.data.readers import images
from gsencoder.data.readers.images import (
    DepthFiles,
    ImageFiles,
    PixelGrid,
    picture_info,
    picture_size,
    read_integers,
    read_mask,
    read_rgba,
    read_small,
)
from gsencoder.data.readers.masks import LabelFiles, MaskFiles
from gsencoder.data.readers.posed import CameraModel, check_camera, pinhole_for, remap_between
from gsencoder.types.orientation import EXCHANGED, INVERSE, turned

PINHOLE = CameraModel(model="PINHOLE", width=32, height=24, params=(30.0, 31.0, 16.0, 12.0))


def grid(camera: CameraModel = PINHOLE, width: int = 32, height: int = 24) -> PixelGrid:
    return PixelGrid(source=camera, pinhole=pinhole_for(camera, "test"), width=width, height=height)


def test_color_of_every_mode_becomes_rgb(tmp_path):
    rgb = photograph(0)
    assert (read_rgba(save(tmp_path / "rgb.png", rgb))[0] == rgb).all()
    grey = rgb[..., 0].copy()
    assert (read_rgba(save(tmp_path / "grey.png", grey))[0] == grey[..., None]).all()
    wide = grey.astype(np.uint16) * 256 + 7
    assert (read_rgba(save(tmp_path / "wide.png", wide))[0] == grey[..., None]).all()
    Image.fromarray(rgb).quantize(256).save(tmp_path / "palette.png")
    color, alpha = read_rgba(tmp_path / "palette.png")
    assert color.shape == rgb.shape
    assert alpha is None
    Image.fromarray(rgb).convert("CMYK").save(tmp_path / "cmyk.jpg")
    assert read_rgba(tmp_path / "cmyk.jpg")[0].shape == rgb.shape


@pytest.mark.parametrize("value", [-1, 65_536])
def test_grey_values_beyond_sixteen_bits_on_either_side_are_refused(tmp_path, value):
    grey = np.full((24, 32), 65_535, np.int32)
    Image.fromarray(grey).save(tmp_path / "grey.tif")
    assert (read_rgba(tmp_path / "grey.tif")[0] == 255).all()
    grey[3, 4] = value
    Image.fromarray(grey).save(tmp_path / "grey.tif")
    with pytest.raises(InputError, match="grey values beyond 16 bits"):
        read_rgba(tmp_path / "grey.tif")


def test_alpha_composites_over_black_and_becomes_the_mask(tmp_path):
    rgba = np.dstack([photograph(0), np.full((24, 32), 255, np.uint8)])
    rgba[:, :8, 3], rgba[:, 8:16, 3], rgba[:, 16:20, 3] = 0, 127, 128
    path = save(tmp_path / "a.png", rgba)
    assert picture_info(path) == ((32, 24), True, 1)
    color = ImageFiles([path], [grid()])[0]
    assert np.abs(color - rgba[..., :3] * (rgba[..., 3:] / 255.0)).max() <= 0.5
    mask = MaskFiles([None], [grid()], [path])[0]
    assert not mask[:, :16].any()
    assert mask[:, 16:].all()


def test_files_that_are_no_pictures_are_errors_that_name_them(tmp_path):
    (tmp_path / "text.png").write_text("not a picture")
    (tmp_path / "empty.jpg").write_bytes(b"")
    (tmp_path / "ps.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n")
    (tmp_path / "folder.png").mkdir()
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(photograph(0)).save(tmp_path / "turned.tiff", exif=exif)
    for name in ("text.png", "empty.jpg", "ps.png", "folder.png", "turned.tiff"):
        with pytest.raises(InputError, match=name):
            picture_size(tmp_path / name)
    with pytest.raises(InputError, match="no such file"):
        picture_size(tmp_path / "nowhere.png")


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp"])
def test_a_truncated_picture_is_an_error_that_names_it(tmp_path, suffix):
    path = save(tmp_path / f"cut.{suffix}", photograph(0, 64, 64))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=f"cut.{suffix}"):
        ImageFiles([path], [grid()])[0]


def bomb(width: int, height: int) -> bytes:
    """A PNG of a few hundred bytes whose header claims width × height."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, 2, 0, 0, 0])
    chunks = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(b"\0" * 100)), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


@pytest.mark.parametrize("size", [(9000, 9000), (2**31 - 1, 2**31 - 1)])
def test_a_decompression_bomb_is_refused_by_its_header(tmp_path, size):
    (tmp_path / "bomb.png").write_bytes(bomb(*size))
    for read in (picture_size, picture_info, read_rgba, lambda path: read_integers(path, "depth", wide=True)):
        with pytest.raises(InputError, match=r"bomb\.png"):
            read(tmp_path / "bomb.png")


def test_depth_comes_from_png_and_npy_in_world_units(tmp_path):
    values = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32) * 80
    png = save(tmp_path / "d.png", values)
    metres = values * 1e-3
    metres[0, :4] = [np.nan, np.inf, -np.inf, 0]
    np.save(tmp_path / "d.npy", metres)
    images = [with_depth(png, 1e-3), with_depth(tmp_path / "d.npy"), with_depth(None)]
    files = DepthFiles(images, [grid()] * 3)
    assert (files[0] == (values * 1e-3).astype(np.float32)).all()
    assert not files[1][0, :4].any()
    assert (files[1][1:] == files[0][1:]).all()
    assert not files[2].any()
    assert files[2].dtype == np.float32


def test_depth_of_a_wrong_kind_is_an_error(tmp_path):
    cases = {"eight.png": photograph(0)[..., 0].copy(), "rgb.png": photograph(0)}
    for name, values in cases.items():
        with pytest.raises(InputError, match=f"{name}: depth must be a 16-bit"):
            DepthFiles([with_depth(save(tmp_path / name, values))], [grid()])[0]
    np.save(tmp_path / "negative.npy", np.full((24, 32), -1.0))
    np.save(tmp_path / "cube.npy", np.zeros((24, 32, 2)))
    np.save(tmp_path / "pickle.npy", np.array([[{}]], dtype=object), allow_pickle=True)
    np.save(tmp_path / "huge.npy", np.full((24, 32), 1e300))
    problems = {"negative": "negative", "cube": r"\[H, W\]", "pickle": "readable", "huge": "depth scale"}
    for name, problem in problems.items():
        with pytest.raises(InputError, match=f"{name}.npy.*{problem}"):
            DepthFiles([with_depth(tmp_path / f"{name}.npy")], [grid()])[0]
    # A header that claims more than the file holds.
    data = (tmp_path / "negative.npy").read_bytes()
    (tmp_path / "cut.npy").write_bytes(data[:-8])
    with pytest.raises(InputError, match=r"cut\.npy"):
        picture_size(tmp_path / "cut.npy")


def test_instances_keep_their_numbers(tmp_path):
    wide = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32) * 80
    narrow = (wide % 256).astype(np.uint8)
    paths = [save(tmp_path / "wide.png", wide), save(tmp_path / "narrow.png", narrow), None]
    files = LabelFiles(paths, [grid()] * 3)
    assert (files[0] == wide).all()
    assert (files[1] == narrow).all()
    assert files[0].dtype == np.int32
    with pytest.raises(InputError, match="one channel"):
        LabelFiles([save(tmp_path / "rgb.png", photograph(0))], [grid()])[0]


def test_alpha_is_no_mask_and_a_palette_has_numbers_and_a_quick_look_is_large_enough(tmp_path):
    values = np.zeros((24, 32, 4), np.uint8)
    values[..., 3], values[:5, :, 1] = 255, 9
    assert (read_mask(save(tmp_path / "mask.png", values)) == (np.arange(24) < 5)[:, None]).all()
    numbers = np.arange(24 * 32, dtype=np.uint8).reshape(24, 32) % 7
    palette = Image.fromarray(numbers)
    palette.putpalette([*range(100, 121)])
    palette.save(tmp_path / "palette.png")
    assert (read_integers(tmp_path / "palette.png", "a map", wide=False) == numbers).all()
    assert read_small(save(tmp_path / "wide.png", photograph(0, 200, 40)), 20).shape == (20, 100, 3)


def test_sequences_index_like_lists(tmp_path):
    paths = [save(tmp_path / f"{i}.png", photograph(i)) for i in range(4)]
    files = ImageFiles(paths, [grid()] * 4)
    assert len(files) == 4
    assert (files[-1] == photograph(3)).all()
    assert (files[np.int64(2)] == photograph(2)).all()
    assert [(a == photograph(i)).all() for i, a in zip((3, 2, 1, 0), files[::-1], strict=True)] == [True] * 4
    with pytest.raises(IndexError):
        files[4]


def test_a_file_that_changed_its_size_after_loading_is_an_error(tmp_path):
    path = save(tmp_path / "a.png", photograph(0, 31, 24))
    with pytest.raises(InputError, match=r"a\.png: 31×24 pixels, expected 32×24"):
        ImageFiles([path], [grid()])[0]


def wide_photograph(folder: Path, suffix: str) -> Path:
    """400 × 300 pixels with edges, gradients and grain."""
    draw = np.random.default_rng(0)
    rows, columns = np.mgrid[:300, :400]
    values = np.stack((columns / 2, rows / 2, 120 * ((columns // 25 + rows // 25) % 2)), axis=2)
    pixels = np.clip(values + draw.normal(0, 4, (300, 400, 1)), 0, 255).astype(np.uint8)
    path = folder / f"wide.{suffix}"
    Image.fromarray(pixels).save(path, **({"quality": 93} if suffix == "jpg" else {}))
    return path


@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize("params", [(350.0, 350.0, 200.0, 150.0), (350.0, 350.0, 200.0, 150.0, -0.05, 0.01, 0.0, 0.0)])
@pytest.mark.parametrize(("width", "reduction"), [(37, 4), (150, 1)])
def test_a_reduced_photograph_is_as_the_full_one_made_smaller(tmp_path, suffix, params, width, reduction):
    model = "OPENCV" if len(params) > 4 else "PINHOLE"
    camera = CameraModel(model=model, width=400, height=300, params=params)
    small = grid(camera, width, round(width * 0.75))
    assert small.reduction == reduction
    path = wide_photograph(tmp_path, suffix)
    expected, remap = read_rgba(path)[0], remap_between(small.pinhole, camera)
    if remap is not None:
        expected = remap.bilinear(expected)
    expected = np.asarray(Image.fromarray(expected).resize((small.width, small.height), Image.Resampling.BOX))
    differences = np.abs(ImageFiles([path], [small])[0].astype(int) - expected)
    # Of 255, where the edges of the checkers have 120.
    assert differences.mean() < (1.8 if reduction > 1 else 1e-9)
    assert differences.max() <= 20


@pytest.mark.parametrize("turn", [1, *EXCHANGED])
def test_a_photograph_is_made_smaller_without_a_shift_turned_or_not(tmp_path, turn):
    """Its sides are no multiples of what it could be decoded smaller by: 3 of 104 columns are missing."""
    ramp = np.broadcast_to(np.round(2.5 * np.arange(101)).astype(np.uint8)[:, None], (74, 101, 3))
    path = save(tmp_path / "turned.png", turned(ramp, INVERSE[turn]))
    camera = CameraModel(model="PINHOLE", width=101, height=74, params=(90.0, 90.0, 50.5, 37.0))
    small = replace(grid(camera, 12, 9), turn=turn)
    expected = Image.fromarray(ramp).resize((12, 9), Image.Resampling.BOX)
    color = ImageFiles([path], [small])[0]
    assert np.abs(color.astype(int) - np.asarray(expected)).max() <= 2


def test_a_file_has_the_shape_of_its_photograph_up_to_less_than_a_pixel_and_a_square_one_is_not_turned():
    turning = replace(grid(), turn=6)
    for width, height, fits in ((16, 12, True), (64, 48, True), (17, 12, False), (15, 12, False), (12, 16, False)):
        assert grid().fits(width, height) == fits
        assert turning.fits(height, width) == (fits or (width, height) == (12, 16))
    assert turning.is_exchanged(12, 16)
    assert not turning.is_exchanged(16, 16)
    assert not grid().is_exchanged(12, 16)


def test_a_photograph_is_decoded_once_until_its_file_changes(tmp_path, monkeypatch):
    decoded = []

    def counted(path: Path, reduction: int) -> object:
        decoded.append(path)
        return read_rgba(path, reduction=reduction)

    monkeypatch.setattr(images, "read_rgba", counted)
    path = save(tmp_path / "a.png", photograph(0))
    first = ImageFiles([path], [grid()])[0]
    again = ImageFiles([path], [grid()])[0]
    again[:] = 0  # A copy.
    np.testing.assert_array_equal(ImageFiles([path], [grid()])[0], first)
    assert len(decoded) == 1
    ImageFiles([path], [grid(width=16, height=12)])[0]
    assert len(decoded) == 2
    save(path, 255 - photograph(0))
    assert (ImageFiles([path], [grid()])[0] == 255 - first).all()
    # Those that were looked at last stay where there is room for two.
    monkeypatch.setattr(images, "KEPT_BYTES", 2 * 24 * 32 * 3)
    files = ImageFiles([save(tmp_path / f"{name}.png", photograph(0)) for name in "bcd"], [grid()] * 3)
    count = len(decoded)
    for view, added in ((0, 1), (0, 1), (1, 2), (0, 2), (2, 3), (0, 3), (1, 4)):
        assert files[view].shape == (24, 32, 3)
        assert len(decoded) == count + added


MODELS = {
    "SIMPLE_RADIAL": (600, 360, 270, 0.03),
    "RADIAL": (600, 360, 270, -0.1, 0.01),
    "OPENCV": (600, 610, 355, 275, -0.25, 0.08, 1e-3, -1e-3),
    "FULL_OPENCV": (600, 600, 360, 270, -0.2, 0.05, 0, 0, 0.01, 0.01, 0, 0),
    "OPENCV_FISHEYE": (400, 400, 360, 270, 0.01, -0.01, 0, 0),
    "SIMPLE_FISHEYE": (400, 360, 270),
    "FISHEYE": (400, 400, 360, 270),
    "SIMPLE_RADIAL_FISHEYE": (400, 360, 270, 0.02),
    "RADIAL_FISHEYE": (400, 360, 270, 0.02, 0.01),
    "THIN_PRISM_FISHEYE": (400, 400, 360, 270, 0.01, 0, 1e-3, 1e-3, 0, 0, 1e-3, 1e-3),
    "RAD_TAN_THIN_PRISM_FISHEYE": (400, 400, 360, 270, 0.01, *([1e-4] * 11)),
    "FOV": (600, 600, 360, 270, 0.6),
    "EUCM": (500, 500, 360, 270, 0.6, 1.1),
    "SIMPLE_DIVISION": (600, 360, 270, -0.1),
    "DIVISION": (600, 600, 360, 270, -0.1),
}


def model(name: str, *params: float, width: int = 720, height: int = 540) -> CameraModel:
    return CameraModel(model=name, width=width, height=height, params=tuple(map(float, params or MODELS[name])))


@pytest.mark.parametrize("name", MODELS)
def test_every_invertible_model_maps_pinhole_pixels_to_their_rays(name):
    from gsencoder.data.readers.posed import load_pycolmap

    camera = model(name)
    pinhole = pinhole_for(camera, "test")
    assert 0.7 <= pinhole.params[0] / camera.params[0] <= 1.3
    assert (pinhole.width, pinhole.height) == (720, 540)
    remap = remap_between(pinhole, camera)
    assert remap.valid.mean() > 0.99
    # The oracle goes the other way: pycolmap turns the place in the file back into a ray.
    oracle = load_pycolmap().Camera(model=name, width=720, height=540, params=list(camera.params))
    row, column = np.nonzero(remap.valid)
    places = np.stack([remap.x[row, column], remap.y[row, column]], axis=1).astype(np.float64)
    rays = oracle.cam_from_img(places)
    pixels = rays * pinhole.params[:2] + pinhole.params[2:]
    assert np.abs(pixels - np.stack([column + 0.5, row + 0.5], axis=1)).max() < 0.02


def test_a_straight_camera_is_not_resampled():
    for name, params in (("OPENCV", (600, 600, 360, 270, 0, 0, 0, 0)), ("SIMPLE_RADIAL", (600, 360, 270, 0))):
        camera = model(name, *params)
        assert camera.is_pinhole
        assert remap_between(pinhole_for(camera, "test"), camera) is None
    assert not model("SIMPLE_FISHEYE").is_pinhole


def test_a_folding_polynomial_keeps_only_its_innermost_rays():
    pinhole = (420, 420, 360, 270)
    remap = remap_between(model("PINHOLE", *pinhole), model("OPENCV", *pinhole, -0.5, 0, 0, 0))
    y, x = np.mgrid[:540, :720] + 0.5
    radius = np.hypot(x - 360, y - 270) / 420
    fold = np.sqrt(1 / 1.5)
    assert remap.valid[radius < fold - 0.01].all()
    assert not remap.valid[radius > fold + 0.01].any()


def test_pixels_without_content_are_black_and_masked(tmp_path):
    # A pincushion so strong that no zoom covers the corners.
    camera = model("SIMPLE_RADIAL", 400, 360, 270, 0.7)
    path = save(tmp_path / "white.png", np.full((540, 720, 3), 255, np.uint8))
    g = PixelGrid(source=camera, pinhole=pinhole_for(camera, "test"), width=720, height=540)
    image = ImageFiles([path], [g])[0]
    mask = MaskFiles([None], [g], [None])[0]
    assert 0.5 < mask.mean() < 1
    assert (image[mask] == 255).all()
    assert not image[~mask].any()
    depth = save(tmp_path / "depth.png", np.full((540, 720), 7, np.uint16))
    assert ((DepthFiles([with_depth(depth)], [g])[0] == 7) == mask).all()
    half = PixelGrid(source=camera, pinhole=g.pinhole, width=360, height=270)
    small = MaskFiles([None], [half], [None])[0]
    assert (small == mask.reshape(270, 2, 360, 2).all(axis=(1, 3))).all()


@pytest.mark.parametrize(
    ("camera", "problem"),
    [
        (model("EQUIRECTANGULAR", 720, 360, height=360), "EQUIRECTANGULAR"),
        (model("OPENCV", 60, 60, 360, 270, -2, 0, 0, 0), "inverted on only"),
        (model("PINHOLE", 20, 20, 360, 270), "170°"),
        (model("PINHOLE", -1, 20, 360, 270), "focal length"),
        (model("PINHOLE", np.nan, 20, 360, 270), "finite"),
        (model("PINHOLE", 1e8, 1e8, 360, 270), "is not a camera's"),
        (model("PINHOLE", 500, 500, 360, 270, width=0), "picture size"),
        (model("OPENCV", 500, 500, 360, 270, 0.1), "do not fit"),
    ],
)
def test_cameras_that_cannot_be_undistorted_are_named_errors(camera, problem):
    with pytest.raises(InputError, match=f"^here: .*{problem}"):
        pinhole_for(camera, "here")


@settings(max_examples=40, deadline=None)
@given(
    name=st.sampled_from(sorted(MODELS)),
    extra=st.lists(st.floats(-2, 2), min_size=12, max_size=12),
    focal=st.floats(1, 1e5),
)
def test_any_distortion_gives_a_bounded_remap_or_an_input_error(name, extra, focal):
    base = len(MODELS[name])
    focals = 1 if name.startswith("SIMPLE") or name.startswith("RADIAL") else 2
    params = ([focal] * focals + [30.0, 20.0] + extra)[:base]
    camera = CameraModel(model=name, width=60, height=40, params=tuple(params))
    try:
        check_camera(camera, "here")
        pinhole = pinhole_for(camera, "here")
    except InputError:
        return
    remap = remap_between(pinhole, camera)
    x, y = remap.x[remap.valid], remap.y[remap.valid]
    assert ((x >= 0) & (x <= 60) & (y >= 0) & (y <= 40)).all()
