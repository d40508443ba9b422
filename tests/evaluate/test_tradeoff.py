"""The sweep: which settings are tried, which are on the front, what a budget picks, and one real run."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsencoder.app import cli
from gsencoder.core.errors import InputError
from gsencoder.data.synthetic.room import make_room, write_room
from gsencoder.evaluate.tradeoff import (
    BudgetConfig,
    SettingResult,
    SweepConfig,
    mark_pareto_front,
    pick_within_budget,
    sweep_settings,
)
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.text.table import make_text_table, save_text_table

pytestmark = pytest.mark.slow

SMALL = SweepConfig(
    rays_per_patch=(1, 4), min_weight=(), stop_transmittance=(0.1,), energy=(), max_rank=(2,), views=(3,), rounds=1
)


def trade(label: str, seconds: float, error: float) -> SettingResult:
    knobs = {"views": len(label)}
    return SettingResult(
        label=label, knobs=knobs, seconds=seconds, mib=1.0, rank=1.0, error=error, raw_error=0.0, covered=1.0, hits=()
    )


def test_one_knob_is_changed_at_a_time_and_the_defaults_come_first() -> None:
    base = FuseConfig()
    settings = sweep_settings(SMALL, base)
    assert settings[0] == ({}, base)
    assert [knobs for knobs, _ in settings[1:]] == [
        {"rays_per_patch": 1}, {"rays_per_patch": 4}, {"stop_transmittance": 0.1}, {"max_rank": 2}, {"views": 3},
    ]  # fmt: skip
    assert settings[1][1].blend.rays_per_patch == 1
    assert settings[-1][1].views == 3


def test_a_value_that_is_the_default_is_not_tried_twice() -> None:
    base = FuseConfig()
    sweep = SweepConfig(
        rays_per_patch=(base.blend.rays_per_patch,),
        min_weight=(),
        stop_transmittance=(),
        energy=(),
        max_rank=(),
        views=(),
    )
    assert len(sweep_settings(sweep, base)) == 1


def test_a_grid_tries_all_with_all() -> None:
    sweep = SweepConfig(
        rays_per_patch=(1,), min_weight=(0.1,), stop_transmittance=(), energy=(), max_rank=(), views=(2, 3), grid=True
    )
    settings = sweep_settings(sweep, FuseConfig())
    assert len(settings) == 2 * 2 * 3
    assert len({json.dumps(knobs) for knobs, _ in settings}) == len(settings)


def test_the_front_holds_what_nothing_beats() -> None:
    trades = mark_pareto_front(
        [trade("a", 1.0, 0.3), trade("b", 2.0, 0.2), trade("c", 3.0, 0.25), trade("d", 2.0, 0.2)]
    )
    assert [one.on_front for one in trades] == [True, True, False, True]


def test_a_budget_of_error_takes_the_fastest_and_one_of_seconds_the_most_exact() -> None:
    trades = [trade("reference", 0.1, 0.0), trade("slow", 3.0, 0.1), trade("mid", 2.0, 0.2), trade("fast", 1.0, 0.3)]
    assert pick_within_budget(trades, BudgetConfig(error=0.25)).label == "mid"
    assert pick_within_budget(trades, BudgetConfig(seconds=2.5)).label == "mid"
    assert pick_within_budget(trades, BudgetConfig(seconds=5.0, error=0.3)).label == "fast"
    with pytest.raises(InputError, match=r"fastest \(fast\).*most exact \(slow\)"):
        pick_within_budget(trades, BudgetConfig(seconds=0.5))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tradeoff") / "room"
    room = make_room(0, objects=4, views=4, width=96, height=72)
    write_room(room, folder)
    names = sorted({one.name for one in room.objects if one.name})
    vectors = np.linalg.qr(np.random.default_rng(0).normal(size=(80, len(names))))[0].T.astype(np.float32)
    save_text_table(folder / "words.safetensors", make_text_table(names, vectors, "t"))
    return folder


def test_the_command_measures_writes_and_advises(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    sweep = ["sweep.rays_per_patch=[1]", "sweep.min_weight=[0.2]", "sweep.stop_transmittance=[]", "sweep.energy=[]"]
    sweep += ["sweep.max_rank=[1]", "sweep.views=[2]", "sweep.rounds=1", "asked.min_views=1"]
    teacher = [f"teacher.words={scene / 'words.safetensors'}", "teacher.cell=8"]
    assert cli.main(["tradeoff", str(scene), *teacher, *sweep, "seeds.voxel=0.05", "budget.error=2", f"out={out}"]) == 0
    with open(out / "tradeoff.csv", newline="") as stream:
        rows = {row["setting"]: row for row in csv.DictReader(stream)}
    labels = ["reference", "defaults", "rays_per_patch=1", "min_weight=0.2", "max_rank=1", "views=2"]
    assert list(rows) == labels
    errors = {name: float(row["error"]) for name, row in rows.items()}
    assert errors["reference"] == pytest.approx(0, abs=1e-6)
    assert errors["defaults"] < min(errors[name] for name in labels[2:])
    assert float(rows["max_rank=1"]["rank"]) == 1
    assert int(rows["defaults"]["objects"]) == 3  # One of four is hidden from every camera.
    with Image.open(out / "tradeoff.png") as plot:
        assert plot.size[0] > 500
    assert "budget: " in capsys.readouterr().out
    assert json.loads((out / "summary.json").read_text())["results"]["picked"].startswith("budget: ")


@pytest.mark.parametrize("wrong", ["sweep.min_weight=[2]", "sweep.rounds=0", "sweep.views=[-1]", "sweep.energy=[0]"])
def test_a_knob_out_of_range_is_refused(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], wrong: str
) -> None:
    teacher = f"teacher.words={scene / 'words.safetensors'}"
    assert cli.main(["tradeoff", str(scene), teacher, wrong, f"out={tmp_path / 'out'}", "quiet=true"]) == 2
    line = capsys.readouterr().err
    assert wrong.split("=")[0].split(".")[1] in line
    assert len(line.splitlines()) == 1
    assert not (tmp_path / "out").exists()
