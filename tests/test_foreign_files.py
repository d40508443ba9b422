"""What a scene or an option names is a regular file: pipes and devices end with an error, within a second."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from no_files import ends_within, make_no_file

from gsencoder.core.archive import read_npz
from gsencoder.core.errors import InputError
from gsencoder.core.files import TEXT_BYTES, check_foreign, open_foreign, read_foreign, read_foreign_text
from gsencoder.core.pretrained import load_companion, open_session, read_config
from gsencoder.data.labels.files import read_checked
from gsencoder.data.labels.mesh import read_mesh
from gsencoder.data.readers.colmap import read_colmap
from gsencoder.data.readers.images import load_npy, open_picture
from gsencoder.data.readers.posed import table_lines
from gsencoder.data.readers.transforms_json import read_json
from gsencoder.data.splats.files import load_property, load_splat
from gsencoder.data.splats.ply import read_points
from gsencoder.evaluate.benchmarks.files import scene_files
from gsencoder.text.models import _load_tokenizer

READERS: dict[str, Callable[[Path], object]] = {
    "picture.png": open_picture,
    "depth.npy": load_npy,
    "poses.txt": table_lines,
    "pose.json": read_json,
    "splat.ply": load_splat,
    "further.ply": lambda path: load_property(path, "x"),
    "truth.txt": read_checked,
    "mesh.ply": read_mesh,
    "points.ply": read_points,
    "model.onnx": lambda path: open_session(path, "a test"),
    "tokenizer.json": _load_tokenizer,
    "config.json": lambda path: read_config(path.parent, "a test"),
    "chat_template.jinja": lambda path: load_companion(object, path.parent, "a test", "template"),
    "masks.npz": lambda path: read_npz(path, {"pred_masks": ("b", 2)}),
    "bytes": read_foreign,
    "text": read_foreign_text,
}


@pytest.fixture(autouse=True)
def _ends():
    with ends_within(1.0):
        yield


@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize("name", READERS)
def test_a_pipe_and_a_device_are_refused_by_every_reader(tmp_path, name, kind):
    path = make_no_file(tmp_path / name, kind)
    with pytest.raises(InputError, match="not a regular file") as caught:
        READERS[name](path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_a_binary_model_that_is_no_file_is_refused(tmp_path, kind):
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        make_no_file(tmp_path / name, kind)
    with pytest.raises(InputError):
        read_colmap(tmp_path, tmp_path, tmp_path)


def test_links_to_files_are_read_and_large_files_are_not(tmp_path):
    (tmp_path / "file").write_bytes(b"\xef\xbb\xbfa\r\nb")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    assert read_foreign_text(tmp_path / "link") == "a\nb"
    assert len(read_foreign(tmp_path / "link", 7)) == 7
    for refuse in (read_foreign, read_foreign_text, open_foreign, check_foreign):
        with pytest.raises(InputError, match="7 bytes; at most 6"):
            refuse(tmp_path / "link", 6)
    with (tmp_path / "large").open("wb") as stream:
        stream.truncate(TEXT_BYTES + 1)
    with pytest.raises(InputError, match="at most 268,435,456 are read"):
        read_foreign_text(tmp_path / "large")
    with pytest.raises(InputError, match="is a folder"):
        open_foreign(tmp_path)
    with pytest.raises(FileNotFoundError):
        open_foreign(tmp_path / "missing")


@pytest.mark.parametrize("kind", ["pipe", "dangling"])
def test_truth_of_a_scene_that_cannot_be_read_is_named_and_not_left_out(tmp_path, kind):
    for folder in ("predictions", "truth"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.txt").write_text("1\n")
    path = tmp_path / "truth" / "b.txt"
    if kind == "dangling":
        path.symlink_to(tmp_path / "gone")
    else:
        make_no_file(path, kind)
    with pytest.raises(InputError, match=r"b\.txt"):
        scene_files(tmp_path / "predictions", tmp_path / "truth")


def test_masks_are_refused_by_their_declared_size(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "a.npz", pred_masks=np.zeros((2048, 1024), bool))
    kinds = {"pred_masks": ("b", 2)}
    assert read_npz(tmp_path / "a.npz", kinds)["pred_masks"].shape == (2048, 1024)
    monkeypatch.setattr("gsencoder.core.archive.LARGEST_ARRAY", 1 << 20)
    with pytest.raises(InputError, match="claims"):
        read_npz(tmp_path / "a.npz", kinds)
