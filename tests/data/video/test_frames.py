"""Frames of video files: upright, sharp, written once, and nothing bad gets in."""

import sys
from fractions import Fraction
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pans import blurred, looking_at
from PIL import Image

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.images import picture_size
from gsencoder.data.video import RECORD_FILE, Video, VideoConfig, color_picture, take_frames

av = pytest.importorskip("av")


def write_video(path: Path, pictures: list[np.ndarray], *, rotation: int = 0, codec: str = "libx264") -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        if rotation:
            stream.set_display_rotation(rotation)
        for picture in pictures:
            rgb = np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture
            for packet in stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


@cache
def pan(count: int = 61, step: float = 6.0) -> list[np.ndarray]:
    """A camera that moves to the side; every third frame is sharp."""
    pictures = [looking_at(step * index) for index in range(count)]
    return [picture if index % 3 == 0 else blurred(picture, 3) for index, picture in enumerate(pictures)]


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("video") / "walk.mp4", pan())


def numbers(names: tuple[str, ...]) -> np.ndarray:
    return np.array([int(name[6:12]) for name in names])


def test_sharp_frames_are_written_with_their_number_in_the_video(video, tmp_path):
    names = take_frames(video, tmp_path / "images")
    assert sorted(path.name for path in (tmp_path / "images").iterdir()) == [*names, RECORD_FILE]
    frame_numbers = numbers(names)
    assert (frame_numbers % 3 == 0).all()
    # 60 steps of 6 pixels are 0.94 of the width, and the fewest frames are closer together than video.motion.
    assert 8 <= len(frame_numbers) <= 16
    stored = np.stack(pan()).astype(np.float32)
    for name, number in zip(names, frame_numbers, strict=True):
        with Image.open(tmp_path / "images" / name) as file:
            picture = np.asarray(file.convert("L"), np.float32)
        assert np.abs(stored - picture).mean(axis=(1, 2)).argmin() == number


@pytest.mark.parametrize("size", [100, 5000])
def test_frames_are_made_smaller_and_never_larger(video, tmp_path, monkeypatch, size):
    monkeypatch.setattr("gsencoder.data.video.PIXELS", size)
    names = take_frames(video, tmp_path / "images", VideoConfig(frames=6))
    assert len(names) == 6
    assert max(picture_size(tmp_path / "images" / names[0])) == min(size, 384)


@pytest.mark.parametrize("rotation", [90, -90, 180])
def test_a_video_that_was_taken_upright_gives_upright_frames(tmp_path, rotation):
    picture = np.zeros((64, 96, 3), np.uint8)
    picture[:16, :24] = 255  # A white corner at the upper left of what is stored.
    path = write_video(tmp_path / "phone.mp4", [picture] * 3, rotation=rotation)
    first = next(Video(path).frames())
    # PyAV and the display matrix of the file agree on counterclockwise; numpy turns the same way.
    assert round(first.rotation) % 360 == rotation % 360
    turned = np.rot90(picture, rotation // 90)
    np.testing.assert_allclose(color_picture(first, 96).astype(int), turned.astype(int), atol=30)


def test_pixels_that_are_not_square_become_square(tmp_path):
    path = tmp_path / "wide.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 72, 64, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        for packet in (*stream.encode(av.VideoFrame(72, 64, "yuv420p")), *stream.encode()):
            container.mux(packet)
    video = Video(path)
    assert video.pixel_aspect == pytest.approx(4 / 3)
    assert color_picture(next(video.frames()), 400, video.pixel_aspect).shape == (64, 96, 3)


def test_frames_are_taken_again_only_for_another_file_or_settings_or_when_damaged(video, tmp_path):
    folder = tmp_path / "images"

    def times() -> dict[str, int]:
        return {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}

    names = take_frames(video, folder)
    before = times()
    assert take_frames(video, folder) == names
    assert times() == before
    (folder / names[1]).unlink()
    assert take_frames(video, folder) == names
    assert times()[names[0]] != before[names[0]]
    (folder / RECORD_FILE).write_text("{", encoding="utf-8")
    assert take_frames(video, folder) == names
    assert len(take_frames(video, folder, VideoConfig(frames=5))) == 5
    assert len(list(folder.iterdir())) == 6


def test_a_video_that_was_cut_off_gives_what_can_be_decoded_and_a_warning(tmp_path):
    whole = write_video(tmp_path / "whole.mkv", pan(90, step=6.0))
    cut = tmp_path / "cut.mkv"
    data = whole.read_bytes()
    cut.write_bytes(data[: len(data) // 2])
    with pytest.warns(SceneWarning, match=r"cut.mkv: is damaged or cut off: [12]\.\d s of 3\.0 s can be decoded; the"):
        names = take_frames(cut, tmp_path / "images")
    assert numbers(names).max() < 60


def test_what_is_no_video_is_an_error_of_one_line(tmp_path):
    empty, text, sound = tmp_path / "a.mp4", tmp_path / "b.mp4", tmp_path / "c.mp4"
    empty.write_bytes(b"")
    text.write_text("no video", encoding="utf-8")
    with av.open(str(sound), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        for packet in (*stream.encode(frame), *stream.encode()):
            container.mux(packet)
    for path, expected in ((empty, "not a video"), (text, "not a video"), (sound, "no pictures, only audio")):
        with pytest.raises(InputError, match=expected):
            take_frames(path, tmp_path / "images")


def test_a_camera_that_stands_still_is_an_error_that_names_the_video(tmp_path):
    path = write_video(tmp_path / "still.mp4", [looking_at(100)] * 20)
    with pytest.raises(InputError, match=r"still.mp4: the picture moves by 0% of its width in 20 frames"):
        take_frames(path, tmp_path / "images")


def test_frames_that_are_far_apart_are_warned_of(tmp_path):
    path = write_video(tmp_path / "fast.mp4", pan(40, step=20.0))
    with pytest.warns(SceneWarning, match=r"3 frames are \d+% of the picture's width apart.*video.frames=2\d takes"):
        take_frames(path, tmp_path / "images", VideoConfig(frames=3))


def test_without_pyav_the_error_says_what_to_install(video, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"PyAV, which is missing: pip install 'gsencoder\[video\]'"):
        take_frames(video, tmp_path / "images")
