"""Furniture libraries: sizes, axes, materials, makes, and what is wrong with a file."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from furniture import MATERIALS, MODELS, catalogue, write_library
from PIL import Image

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.furnished import library
from gsencoder.data.furnished.kinds import kind_of, kinds
from gsencoder.data.furnished.library import Model, held_out_models, load_libraries, select_makes


def test_pictures_are_found_in_a_folder_below_the_model(tmp_path: Path) -> None:
    picture = io.BytesIO()
    Image.new("RGB", (8, 8), (0, 0, 255)).save(picture, "PNG")
    materials = MATERIALS.replace("back.png", "maps/back.png").encode()
    files = {"box/back.png": b"", "box/box.mtl": materials, "box/maps/back.png": picture.getvalue()}
    mesh = load_libraries([write_library(tmp_path / "below.sh3f", files=files)])[0].mesh
    assert sum(texture is not None for texture in mesh.textures) == 1


def test_a_model_has_the_size_of_the_catalogue_and_stands_on_the_floor(models: tuple[Model, ...]) -> None:
    for model in models:
        lower, upper = model.mesh.extent
        np.testing.assert_allclose(upper - lower, model.size, rtol=1e-5)
        np.testing.assert_allclose((lower + upper)[:2], 0, atol=1e-6)
        assert lower[2] == pytest.approx(0, abs=1e-6)
    assert {model.elevation for model in models} == {0, 0.9, 1.45}


@pytest.mark.parametrize(("rotation", "axis", "side"), [("1 0 0 0 1 0 0 0 1", 1, 1), ("0 0 1 0 1 0 -1 0 0", 0, 0)])
def test_the_front_of_a_model_is_at_the_lower_side_of_y_after_its_rotation(rotation, axis, side, tmp_path):
    """In the file the textured side is at −z of y up, the back of the model, which the second rotation takes to −x."""
    rows = [(*MODELS[0][:3], {"modelRotation": rotation})]
    mesh = load_libraries([write_library(tmp_path / "test.sh3f", catalogue(rows))])[0].mesh
    textured = [number for number, texture in enumerate(mesh.textures) if texture is not None]
    back = mesh.vertices[mesh.faces[np.isin(mesh.materials, textured)]].reshape(-1, 3)
    np.testing.assert_allclose(back[:, axis], mesh.extent[side, axis])


def test_materials_are_colors_and_pictures(models: tuple[Model, ...]) -> None:
    mesh = models[0].mesh
    by_texture = {texture is not None: color for texture, color in zip(mesh.textures, mesh.colors, strict=True)}
    np.testing.assert_allclose(by_texture[False], [0.8, 0.2, 0.2], atol=0.01)
    np.testing.assert_allclose(by_texture[True], [0, 0, 1], atol=0.01)


@pytest.mark.parametrize(("back", "faces"), [("0.3", 10), ("0.9", 12), ("clear", 12)])
def test_panes_of_a_model_are_left_out_and_one_all_of_glass_is_whole(back: str, faces: int, tmp_path: Path) -> None:
    materials = {"box/box.mtl": f"newmtl body\nKd 1 0 0\nnewmtl back\nKd 1 1 1\nd {back}\n".encode()}
    (model,) = load_libraries([write_library(tmp_path / "panes.sh3f", catalogue(MODELS[:1]), materials)])
    assert len(model.mesh.faces) == faces
    every = {"box/box.mtl": b"newmtl body\nKd 1 0 0\nd 0.2\nnewmtl back\nKd 1 1 1\nd 0.2\n"}
    (model,) = load_libraries([write_library(tmp_path / "glass.sh3f", catalogue(MODELS[:1]), every)])
    assert len(model.mesh.faces) == 12


def test_what_no_room_has_is_left_out(models: tuple[Model, ...]) -> None:
    assert len(models) == len(MODELS) - 1
    assert all(model.name != "Tractor" for model in models)


def test_one_in_four_makes_of_a_kind_is_held_out_and_none_of_a_kind_of_fewer_than_three(
    models: tuple[Model, ...],
) -> None:
    held = held_out_models(models)
    chosen = [model.kind.name for model in models if model.id in held]
    assert sorted(chosen) == ["chair", "table"]
    train, others = select_makes(models, "train"), select_makes(models, "held_out")
    assert not {model.id for model in train} & held
    assert {model.id for model in train} | held == {model.id for model in models}
    assert [model.id for model in others if model.kind.name in ("chair", "table")] == sorted(held)
    assert {model.kind.name for model in others} == {model.kind.name for model in models}


def test_a_model_of_many_faces_is_simplified_and_keeps_its_size_and_materials(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    n = 60
    grid = [(x, y) for x in range(n + 1) for y in range(n + 1)]
    vertices = [f"v {x} {np.sin(x / 5) * 3 + 4:.4f} {y}" for x, y in grid]
    row = n + 1
    corners = [x * row + y + 1 for x in range(n) for y in range(n)]
    faces = [f"f {at} {at + 1} {at + row + 1} {at + row}" for at in corners]
    text = "\n".join(["mtllib box.mtl", *vertices, "usemtl back", *faces[: 10 * n], "usemtl body", *faces[10 * n :]])
    path = write_library(tmp_path / "fine.sh3f", catalogue(MODELS[:1]), {"box/box.obj": text.encode()})
    monkeypatch.setattr(library, "MAX_FACES", 1000)
    (model,) = load_libraries([path])
    assert 100 < len(model.mesh.faces) <= 1000
    np.testing.assert_allclose(np.ptp(model.mesh.extent, axis=0), model.size, rtol=0.05)
    has_picture = np.array([texture is not None for texture in model.mesh.textures])[model.mesh.materials]
    assert has_picture.mean() == pytest.approx(1 / 6, abs=0.05)


def test_no_word_stands_for_two_kinds() -> None:
    words = [word for kind in kinds().values() for word in kind.words]
    assert len(words) == len(set(words))
    assert all(word == word.strip().lower() for word in words)


def test_an_id_says_more_of_the_kind_than_a_category_and_that_more_than_a_name() -> None:
    known = kind_of("", "Chair", ""), kind_of("", "Chair", "Office"), kind_of("Scopia#bowl", "Chair", "Office")
    assert [kind and kind.name for kind in known] == ["chair", "office chair", "bowl"]


WRONG = {
    "no library": (None, "expected a furniture library"),
    "not a zip archive": (b"not a zip", "expected a zip archive"),
    "half of a file": (b"PK\x03\x04" + bytes(50), "expected a zip archive"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_file_that_is_no_library_is_named(case: str, tmp_path: Path) -> None:
    content, message = WRONG[case]
    path = tmp_path / "wrong.sh3f"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message) as error:
        load_libraries([path])
    assert "wrong.sh3f" in str(error.value)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"width": "0"}, "expected a size in centimetres"),
        ({"height": "5000"}, "expected a size in centimetres"),
        ({"depth": "wide"}, "expected a number of centimetres as its depth, got 'wide'"),
        ({"modelRotation": "1 0 0"}, "a rotation of nine numbers"),
    ],
)
def test_wrong_values_of_a_catalogue_are_named(more: dict[str, str], message: str, tmp_path: Path) -> None:
    path = write_library(tmp_path / "test.sh3f", catalogue([("Chair", "Office", (50, 50, 90), more)]))
    with pytest.raises(InputError, match=message):
        load_libraries([path])


@pytest.mark.parametrize(("unit", "name"), [(0.01, "metres"), (10.0, "millimetres")])
def test_sizes_in_another_unit_are_told_from_centimetres(unit: float, name: str, tmp_path: Path) -> None:
    sizes = {"Chair": (50.0, 50.0, 90.0), "Table": (120.0, 80.0, 75.0), "Mug": (9.0, 9.0, 11.0)}
    rows = [(each, "Office", tuple(unit * side for side in size), {}) for each, size in sizes.items()]
    path = write_library(tmp_path / "test.sh3f", catalogue(rows))  # type: ignore[arg-type]
    median = rf"test.sh3f: the median length of its models is {unit * 90:g} cm; .* in centimetres, not in {name}$"
    with pytest.raises(InputError, match=median):
        load_libraries([path])


def test_an_incomplete_library_and_a_model_without_faces_are_named(tmp_path: Path) -> None:
    missing = write_library(tmp_path / "missing.sh3f", files={"box/box.obj": b""})
    with pytest.raises(InputError, match=r"model test#1: .*expected the file box/box.obj"):
        load_libraries([missing])[0].mesh  # noqa: B018
    empty = write_library(tmp_path / "empty.sh3f", files={"box/box.obj": b"v 0 0 0\nv 1 1 1\n"})
    with pytest.raises(InputError, match=r"model test#1: .*(no faces|expected an OBJ file)"):
        load_libraries([empty])[0].mesh  # noqa: B018


@pytest.mark.parametrize("bit", range(8))
@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("box/box.obj", "expected a zip archive, got a damaged one"),
        ("box/box.mtl", "box/box.mtl: cannot be read"),
        ("box/back.png", "box/back.png: cannot be read"),
    ],
)
def test_a_flipped_bit_of_a_model_its_materials_or_pictures_is_named(
    file: str, message: str, bit: int, tmp_path: Path
) -> None:
    path = write_library(tmp_path / "flipped.sh3f")
    with zipfile.ZipFile(path) as archive:
        member = archive.getinfo(file)
    content = bytearray(path.read_bytes())
    content[member.header_offset + 30 + len(member.filename) + member.compress_size // 3] ^= 1 << bit
    path.write_bytes(content)
    with pytest.raises(InputError, match=f"model test#1: {message}"):
        load_libraries([path])[0].mesh  # noqa: B018


def test_a_flipped_bit_of_the_directory_of_an_archive_is_an_error_of_the_input_or_changes_nothing(
    tmp_path: Path,
) -> None:
    content = write_library(tmp_path / "whole.sh3f", catalogue(MODELS[:1])).read_bytes()
    path, first = tmp_path / "flipped.sh3f", content.index(b"PK\x01\x02")
    refused = 0
    for at in range(first, first + 46):
        for bit in range(8):
            path.write_bytes(content[:at] + bytes([content[at] ^ 1 << bit]) + content[at + 1 :])
            try:
                assert len(load_libraries([path])[0].mesh.faces) == 12
            except InputError:
                refused += 1
    assert refused > 100


def test_names_in_another_language_are_warned_of(tmp_path: Path) -> None:
    known = write_library(tmp_path / "known.sh3f")
    foreign = write_library(tmp_path / "stuhl.sh3f", catalogue([("Stuhl", "Wohnzimmer", (50, 50, 90), {})]))
    with pytest.warns(SceneWarning, match=r"stuhl.sh3f: of its 1 model, 0 have a name that is known"):
        load_libraries([known, foreign])
    size = (50.0, 50.0, 90.0)
    rows = [(name, "Wohnzimmer", size, {"id": name}) for name in ("Laptop", "Stuhl", "Tisch")]
    mostly = write_library(tmp_path / "laptop.sh3f", catalogue(rows))
    with pytest.warns(SceneWarning, match=r"laptop.sh3f: of its 3 models, 1 have a name that is known"):
        assert [model.name for model in load_libraries([mostly])] == ["Laptop"]
    with pytest.raises(InputError, match="no model of a known kind"), pytest.warns(SceneWarning):
        load_libraries([foreign])


def test_one_library_given_twice_is_refused(tmp_path: Path) -> None:
    path = write_library(tmp_path / "test.sh3f")
    with pytest.raises(InputError, match="give each library once"):
        load_libraries([path, path])
