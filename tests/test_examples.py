"""The numbered examples run on the demo's room, and print and write what they say; the fifth in infer/."""

import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from field_scenes import write_transforms
from PIL import Image

import gsencoder
from gsencoder.app import main as cli
from gsencoder.core.errors import SceneWarning
from gsencoder.data.synthetic import make_room, write_room

pytestmark = pytest.mark.slow
EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "room"
    write_room(make_room(0, objects=6, views=6, width=120, height=90), folder)
    return folder


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """What an example prints, run in the folder of the test."""
    monkeypatch.chdir(tmp_path)

    def printed(number: int, *arguments: object) -> str:
        (script,) = EXAMPLES.glob(f"{number:02d}_*.py")
        monkeypatch.setattr(sys, "argv", [str(script), *map(str, arguments)])
        capsys.readouterr()
        runpy.run_path(str(script), run_name="__main__")
        return capsys.readouterr().out

    return printed


def size_of(picture: Path) -> tuple[int, int]:
    with Image.open(picture) as image:
        return image.size


def test_an_example_fuses_and_localizes(room: Path, tmp_path: Path) -> None:
    """In a process of its own, as users run it; it imports nothing that a test has imported before."""
    words = [sys.executable, "-W", "error", str(EXAMPLES / "01_fuse_and_localize.py"), str(room), "red"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    out = done.stdout
    seen, total = (int(number.replace(",", "")) for number in re.findall(r"[\d,]+\d", out.splitlines()[0]))
    assert 0.9 * total < seen <= total
    assert re.search(r"^red at \[.*\], \d\.\d\d × \d\.\d\d × \d\.\d\d m, score 0\.\d\d, \d+ Gaussians$", out, re.M)
    assert size_of(tmp_path / "relevancy.png") == (240, 90)


def test_an_example_shows_that_lifting_is_the_transpose_of_rendering(run, room, tmp_path):
    out = run(2, room)
    left, right = (float(number) for number in re.findall(r"= (-?[\d.]+)", out)[:2])
    assert left == pytest.approx(right, rel=1e-3, abs=0.5)
    assert float(re.findall(r"gradient and lift: (\S+)", out)[0]) < 1e-4
    assert size_of(tmp_path / "patches.png") == (240, 90)


def test_an_example_encodes_a_splat_and_saves_a_folder_that_localize_takes(run, room, tmp_path):
    # Six boxes and balls on a floor are no room that an encoder of rooms knows.
    doubt = pytest.warns(SceneWarning, match="expects .*% of its names in this scene to be right, fewer than half")
    with doubt, pytest.warns(SceneWarning, match=r"1 of 2 words have no box \('sofa'\)"):
        out = run(3, room, "table,sofa")
    assert re.search(r"^[\d,]+ features of ", out)
    assert re.findall(r"^(table|sofa): \d+ boxes", out, re.MULTILINE) == ["table", "sofa"]
    features = gsencoder.load_features(tmp_path / "encoded").features
    assert len(gsencoder.load_splat(tmp_path / "room.ply")) == len(features["labels-onnx:c5a1baf31b0ff687"])
    assert size_of(tmp_path / "encoded.png") == (240, 90)


def test_an_example_renders_views_of_a_target(run: Callable[..., str], room: Path, tmp_path: Path) -> None:
    fuse = ["fuse", str(room), "teacher=palette", "seeds.voxel=0.05", f"out={tmp_path / 'features'}", "quiet=true"]
    assert cli.main(fuse) == 0
    out = run(4, "features", "red")
    pictures = sorted(tmp_path.glob("view_*.png"))
    assert len(pictures) == len(out.splitlines()) == 8
    assert {size_of(picture) for picture in pictures} == {(640, 480)}
    assert re.match(r"view_00\.png: .*, shows \d+% of red", out)


def test_the_first_commands_of_the_readme_need_nothing_but_gsencoder(field_room, tmp_path, monkeypatch, capsys):
    """Each `fuse` and `localize` of a labeled room, and of photographs with a splat."""
    monkeypatch.delenv("GSENCODER_MODELS", raising=False)
    # Embedding all of them takes seconds.
    monkeypatch.setattr("gsencoder.text.vocabulary.REFERENCE_NOUNS", ("chair", "table", "tree"))
    monkeypatch.chdir(tmp_path)
    shutil.copytree(field_room.room, "outputs/demo/room")
    content = field_room.copy_photographs(Path("splat"))
    shutil.copytree("splat/images", "PHOTOS")
    write_transforms(Path("splat"), content)
    for folder in ("outputs/demo", "splat"):
        shutil.copy(field_room.splat, Path(folder, "splat.ply"))
    readme = (EXAMPLES.parent / "README.md").read_text().partition("## I have a splat")[0]
    lines = [shlex.split(line, comments=True) for line in re.findall(r"^gsencoder (.*)", readme, re.MULTILINE)]
    quick = {"fuse": ["orbits=2", "cameras=around", "data.up=[0,0,1]"], "localize": ["pictures=1"]}
    for command, *words in lines:
        if command in quick:
            assert cli.main([command, *words, *quick[command], "overwrite=true"]) == 0, words
    printed = capsys.readouterr().out
    assert (printed.count("; teacher=labels"), printed.count("; teacher=mosaic text=minilm")) == (1, 1)


def test_examples_are_numbered_and_short_and_use_public_names_alone() -> None:
    scripts = sorted(EXAMPLES.glob("*.py"))
    assert [path.name[:3] for path in scripts] == [f"{number:02d}_" for number in range(1, 6)]
    for path in scripts:
        text = path.read_text()
        assert len(text.splitlines()) <= 60
        imports = set(re.findall(r"^(?:from|import) (gsencoder[\w.]*)", text, re.MULTILINE))
        assert imports <= {"gsencoder", "gsencoder.render"}


@pytest.mark.parametrize("name", gsencoder.__all__)
def test_every_public_name_loads_and_says_what_it_is(name: str) -> None:
    assert (getattr(gsencoder, name).__doc__ or "").strip()
