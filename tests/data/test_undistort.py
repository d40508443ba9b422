import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_files import save, with_depth

from gsencoder.core.errors import InputError
from gsencoder.data.readers.images import DepthFiles, ImageFiles, PixelGrid
from gsencoder.data.readers.masks import MaskFiles
from gsencoder.data.readers.posed import CameraModel, check_camera, pinhole_for, remap_between

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


def model(name: str, width: int = 720, height: int = 540) -> CameraModel:
    return CameraModel(model=name, width=width, height=height, params=tuple(map(float, MODELS[name])))


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
        camera = CameraModel(model=name, width=720, height=540, params=tuple(map(float, params)))
        assert camera.is_pinhole
        assert remap_between(pinhole_for(camera, "test"), camera) is None
    assert not model("SIMPLE_FISHEYE").is_pinhole


def test_a_folding_polynomial_keeps_only_its_innermost_rays():
    camera = CameraModel(
        model="OPENCV", width=720, height=540, params=(420.0, 420.0, 360.0, 270.0, -0.5, 0.0, 0.0, 0.0)
    )
    remap = remap_between(
        CameraModel(model="PINHOLE", width=720, height=540, params=(420.0, 420.0, 360.0, 270.0)), camera
    )
    y, x = np.mgrid[:540, :720] + 0.5
    radius = np.hypot(x - 360, y - 270) / 420
    fold = np.sqrt(1 / 1.5)
    assert remap.valid[radius < fold - 0.01].all()
    assert not remap.valid[radius > fold + 0.01].any()


def test_pixels_without_content_are_black_and_masked(tmp_path):
    # A pincushion so strong that no zoom covers the corners.
    camera = CameraModel(model="SIMPLE_RADIAL", width=720, height=540, params=(400.0, 360.0, 270.0, 0.7))
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
        (CameraModel(model="EQUIRECTANGULAR", width=720, height=360, params=(720.0, 360.0)), "EQUIRECTANGULAR"),
        (
            CameraModel(model="OPENCV", width=720, height=540, params=(60.0, 60.0, 360.0, 270.0, -2.0, 0.0, 0.0, 0.0)),
            "inverted on only",
        ),
        (CameraModel(model="PINHOLE", width=720, height=540, params=(20.0, 20.0, 360.0, 270.0)), "170°"),
        (CameraModel(model="PINHOLE", width=720, height=540, params=(-1.0, 20.0, 360.0, 270.0)), "focal length"),
        (CameraModel(model="PINHOLE", width=720, height=540, params=(float("nan"), 20.0, 360.0, 270.0)), "finite"),
        (CameraModel(model="PINHOLE", width=720, height=540, params=(1e8, 1e8, 360.0, 270.0)), "is not a camera's"),
        (CameraModel(model="PINHOLE", width=0, height=540, params=(500.0, 500.0, 360.0, 270.0)), "picture size"),
        (CameraModel(model="OPENCV", width=720, height=540, params=(500.0, 500.0, 360.0, 270.0, 0.1)), "do not fit"),
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
