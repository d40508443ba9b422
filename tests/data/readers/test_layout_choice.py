"""Which layout a folder has, and which of several files are read."""

from pathlib import Path

import pytest
from PIL import Image

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.posed import ReadOptions
from gsencoder.data.scenes import COLMAP_FOLDERS, colmap_model_in, layout_of, transforms_in


def model(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 8 6 5 5 4 3\n")
    (folder / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    (folder / "points3D.txt").write_text("")


def photograph(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 6)).save(folder / "a.png")


def read_of(folder: Path, **options: str) -> tuple[Path, Path]:
    """The photograph that is read, and the folder of the scene."""
    layout = layout_of(folder)
    assert layout.name == "COLMAP"
    posed, home = layout.read(folder, ReadOptions(**options))  # type: ignore[arg-type]
    return posed.images[0].image, home


@pytest.mark.parametrize("subfolder", COLMAP_FOLDERS)
def test_a_model_is_found_where_tools_put_it(tmp_path, subfolder):
    model(tmp_path / subfolder)
    photograph(tmp_path / "images")
    assert colmap_model_in(tmp_path) == tmp_path / subfolder
    assert read_of(tmp_path) == (tmp_path / "images" / "a.png", tmp_path)


@pytest.mark.parametrize("above", [1, 2])
def test_photographs_may_lie_beside_the_folders_above_the_model_itself(tmp_path, above):
    folder = tmp_path / "scene" / "sparse" / "0"
    model(folder)
    home = folder.parents[above - 1]
    photograph(home / "images")
    assert read_of(folder) == (home / "images" / "a.png", home)


def test_a_model_without_photographs_says_where_they_were_looked_for(tmp_path):
    model(tmp_path / "sparse" / "0")
    with pytest.raises(InputError, match=f"looked for {tmp_path}/images; say images=FOLDER"):
        read_of(tmp_path)


def test_photographs_are_looked_for_in_the_scene_and_from_here(tmp_path, monkeypatch):
    scene = tmp_path / "scene"
    model(scene / "sparse" / "0")
    photograph(scene / "small")
    photograph(tmp_path / "large")
    monkeypatch.chdir(tmp_path)
    assert read_of(scene, images="small")[0] == scene / "small" / "a.png"
    assert read_of(scene, images="large")[0] == Path("large/a.png")
    assert read_of(scene, images=str(tmp_path / "large")) == (tmp_path / "large" / "a.png", scene)
    for missing in ("none", "/none"):
        with pytest.raises(InputError, match=f"images={missing}: no such folder"):
            read_of(scene, images=missing)


def test_the_first_of_several_models_is_used_with_a_warning(tmp_path):
    photograph(tmp_path / "images")
    for number in ("0", "1", "2"):
        model(tmp_path / "sparse" / number)
    (tmp_path / "sparse" / "notes").mkdir()
    with pytest.warns(SceneWarning, match=r"holds 3 models; 0 is used \(or give the folder of 1, 2\)"):
        read_of(tmp_path)


def test_a_transforms_json_comes_before_a_model_and_says_so_unless_it_was_made_from_it(tmp_path):
    photograph(tmp_path / "images")
    frame = '{"file_path": "images/a.png", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}'
    text = f'{{"fl_x": 5, "fl_y": 5, "cx": 4, "cy": 3, "w": 8, "h": 6, "frames": [{frame}]}}'
    (tmp_path / "transforms.json").write_text(text)
    assert transforms_in(tmp_path) == tmp_path / "transforms.json"
    layout = layout_of(tmp_path)
    assert layout.name == "transforms.json"
    # nerfstudio leaves its model in colmap/.
    model(tmp_path / "colmap" / "sparse" / "0")
    posed, home = layout.read(tmp_path, ReadOptions())
    assert (posed.images[0].image, home) == (tmp_path / "images" / "a.png", tmp_path)
    model(tmp_path / "sparse" / "0")
    with pytest.warns(SceneWarning, match="transforms.json is used"):
        layout.read(tmp_path, ReadOptions())
