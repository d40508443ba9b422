"""`gsencoder tradeoff` on a small room: every stage is measured, written, drawn and continued."""

import csv
import json
import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsencoder.app import main as cli
from gsencoder.core.errors import InputError
from gsencoder.core.process import Growth
from gsencoder.data.photographs import Photographs
from gsencoder.data.scenes import SceneConfig
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.evaluate.tradeoff.stages import Inputs, ReconstructionSettings, make_stage
from gsencoder.reconstruct.optimize import OptimizeConfig
from gsencoder.text.table import make_text_table, save_text_table

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _without_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measuring memory collects garbage, which takes long after all that tests have imported."""
    monkeypatch.setattr("gsencoder.evaluate.tradeoff.measure.memory_growth", lambda: nullcontext(Growth()))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tradeoff") / "room"
    room = make_room(0, objects=4, views=4, width=96, height=72)
    write_room(room, folder)
    names = sorted({one.name for one in room.objects if one.name})
    vectors = np.linalg.qr(np.random.default_rng(0).normal(size=(80, len(names))))[0].T.astype(np.float32)
    save_text_table(folder / "words.safetensors", make_text_table(names, vectors, "t"))
    return folder


def words_of(scene: Path, *more: str) -> list[str]:
    teacher = [f"teacher.words={scene / 'words.safetensors'}", "teacher.cell=8"]
    return ["tradeoff", str(scene), *teacher, "seeds.voxel=0.1", "asked.min_views=1", "sweep.rounds=1", *more]


def table_of(out: Path) -> dict[tuple[str, str], dict[str, str]]:
    with open(out / "tradeoff.csv", newline="") as stream:
        return {(row["stage"], row["setting"]): row for row in csv.DictReader(stream)}


def data_of(page: Path) -> dict[str, Any]:
    match = re.search(r'<script id="data" type="application/json">(.*?)</script>', page.read_text(), re.DOTALL)
    assert match
    data = json.loads(match[1])
    assert isinstance(data, dict)
    return data


def test_fusion_is_measured_against_the_exact_features(scene, tmp_path, capsys):
    out = tmp_path / "out"
    sweep = ["sweep.knobs=min_weight,max_rank,views"]
    sweep += ["sweep.values=min_weight:0.2,max_rank:1,views:2", "halving.settings=8"]
    more = ["scaling.points=3", f"out={out}"]
    assert cli.main(words_of(scene, *sweep, *more)) == 0
    rows = {setting: row for (_, setting), row in table_of(out).items() if "," not in setting}
    assert list(rows)[:4] == ["defaults", "views=2", "min_weight=0.2", "max_rank=1"]
    errors = {name: float(row["error"]) for name, row in rows.items()}
    assert errors["defaults"] == min(errors.values())
    assert float(rows["max_rank=1"]["rank"]) == 1
    assert int(rows["max_rank=1"]["bytes"].split(".")[0]) < float(rows["defaults"]["bytes"])
    assert float(rows["defaults"]["acc_25_things"]) == 3  # One of four is hidden from every camera.
    assert float(rows["max_rank=1"]["error_difference"]) == pytest.approx(errors["max_rank=1"] - errors["defaults"])
    with open(out / "scenes.csv", newline="") as stream:
        of_scenes = {row["setting"]: row for row in csv.DictReader(stream)}
    assert {name: float(of_scenes[name]["error"]) for name in errors} == pytest.approx(errors)
    printed = capsys.readouterr().out
    assert "fusion: CPU time grows as channels^" in printed
    written = json.loads((out / "tradeoff.json").read_text())
    assert {each["size"] for each in written["scaling"]} == {"gaussians", "views", "channels", "pixels"}
    assert all(each["low"] <= each["exponent"] <= each["high"] for each in written["scaling"])
    assert sum(row["phase"] == "joint" for row in written["settings"]) >= 1
    page = out / "tradeoff.html"
    assert data_of(page) == written
    assert not re.search(r"(?:src|href)=|https?://(?!www.w3.org/2000/svg)", page.read_text())
    with Image.open(out / "tradeoff.png") as plot:
        assert plot.size[0] > 500
    assert not (tmp_path / "out.tradeoff").exists()


def test_words_packages_and_views_have_scores_of_their_own(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    sweep = ["sweep.knobs=relative,form,candidates", "sweep.values=[relative:0.9,form:index/npz,candidates:3]"]
    sweep += ["choose.candidates=6", "choose.count=2", "choose.width=48", "choose.height=36", "quiet=true"]
    stages = "stages=[localization,packages,views]"
    assert cli.main(words_of(scene, stages, "preset=exact", *sweep, f"out={out}")) == 0
    settings = json.loads((out / "summary.json").read_text())["settings"]
    assert settings["preset"] == "exact"
    assert (settings["fusion"]["max_rank"], settings["choose"]["candidates"]) == (0, 6)
    rows = table_of(out)
    assert set(rows) == {
        ("localization", "defaults"), ("localization", "relative=0.9"), ("packages", "defaults"),
        ("packages", "form=index"), ("packages", "form=npz"), ("views", "defaults"), ("views", "candidates=3"),
    }  # fmt: skip
    package, index, arrays = (rows["packages", each] for each in ("defaults", "form=index", "form=npz"))
    assert float(index["bytes"]) < float(package["bytes"]) < float(arrays["bytes"])
    assert float(arrays["error"]) < 1e-6
    assert 0 < float(rows["views", "defaults"]["object_share"]) < 1
    assert float(rows["views", "defaults"]["bytes"]) > 100
    assert rows["localization", "defaults"]["error"] == ""


@pytest.mark.parametrize("wrong", ["sweep.values=min_weight:2", "sweep.rounds=0", "stages=[]"])
def test_what_is_out_of_range_is_refused(scene, tmp_path, capsys, wrong):
    words = [word for word in words_of(scene) if not word.startswith("sweep.")]
    assert cli.main([*words, wrong, f"out={tmp_path / 'out'}", "quiet=true"]) == 2
    line = capsys.readouterr().err
    assert re.split("[:=]", wrong.partition("=")[2])[0] in line or wrong.partition("=")[0] in line
    assert len(line.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_stage_that_asks_for_words_needs_objects_that_have_names(scene, tmp_path, capsys):
    words = words_of(scene, "stages=localization", "asked.min_pixels=100000", "quiet=true")
    assert cli.main([*words, f"out={tmp_path / 'out'}"]) == 2
    assert "scene room has no object to localize" in capsys.readouterr().err


INPUTS = Inputs(data=SceneConfig(image_scale=0.8), seeds=SeedConfig(voxel=0.12))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("photographs") / "room"
    write_room(make_room(0, objects=3, views=4, width=80, height=60), path)
    return path


@pytest.fixture(scope="module")
def base() -> ReconstructionSettings:
    settings = make_stage("reconstruction", INPUTS).base
    quick = OptimizeConfig(steps=8, sh_degree=1, exposure=False)
    return replace(settings, reconstruct=replace(settings.reconstruct, optimize=quick, holdout=2))


def test_scores_are_those_of_the_reconstruction_itself_in_the_size_that_is_judged(folder, base):
    assert base.data == INPUTS.data
    with make_stage("reconstruction", INPUTS).open(folder) as (run, judge):
        product = run(base)
        scores, size = judge(product, base)
        assert scores["psnr"].total == pytest.approx(product.log[-1]["psnr"], abs=1e-3)
        assert scores["ssim"].total == pytest.approx(product.log[-1]["ssim"], abs=1e-4)
        assert scores["gaussians"].total == len(product.gaussians)
        assert size == 4 * (11 + 12) * len(product.gaussians)
        # What a prediction of exposures expects is in the scores.
        np.testing.assert_array_equal(product.held_out_colors, np.tile(np.eye(3, 4), (len(product.held_out), 1, 1)))
        darker = replace(product, held_out_colors=0.5 * product.held_out_colors)
        assert judge(darker, base)[0]["psnr"].total < scores["psnr"].total - 2


def test_photographs_that_are_fitted_smaller_are_judged_in_the_size_of_all_settings(folder, base, monkeypatch):
    sizes = list[tuple[int, int]]()
    half = replace(base, data=SceneConfig(image_scale=0.4))
    at_scale = Photographs.at_scale

    def seen(self: Photographs, view: int, shrink: int = 1) -> object:
        sizes.append((int(self.cameras.widths[view]), int(self.cameras.heights[view])))
        return at_scale(self, view, shrink)

    with make_stage("reconstruction", INPUTS).open(folder) as (run, judge):
        product = run(half)
        monkeypatch.setattr(Photographs, "at_scale", seen)
        scores, _ = judge(product, half)
    assert sizes == [(64, 48)] * len(product.held_out)
    # A splat that knows a quarter of the pixels looks the sharper, the smaller it is looked at.
    assert scores["ssim"].total < product.log[-1]["ssim"]


def test_a_scene_of_which_nothing_is_held_out_is_refused(folder: Path, base: ReconstructionSettings) -> None:
    none = replace(base, reconstruct=replace(base.reconstruct, holdout=0))
    with make_stage("reconstruction", INPUTS).open(folder) as (run, judge):
        product = run(none)
        with pytest.raises(InputError, match="room: no photograph was held out"):
            judge(product, none)
