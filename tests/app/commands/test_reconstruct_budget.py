"""What a budget of `reconstruct` is counted by: by a clock that stands still but for what takes time."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from command_runs import results_of

from gsencoder.app import main as cli
from gsencoder.app.commands import reconstruct as command
from gsencoder.reconstruct import Reconstruction, reconstruct
from gsencoder.reconstruct.optimize import OptimizeConfig
from gsencoder.reconstruct.plan import Plan, ReconstructBudget
from gsencoder.reconstruct.run import ReconstructConfig
from gsencoder.types import Scene

pytestmark = pytest.mark.slow


def test_seconds_are_counted_from_the_first_reading_on_and_the_plan_is_recorded(room, tmp_path, monkeypatch, capsys):
    """Each reading takes 30 s, and to write the splat 7 s; the optimization says that it took 500 s with those before
    it."""
    now, spent_at = [5.0], dict[str, float]()
    open_scene, save_splat = command._open, command.save_splat
    plan = Plan(steps=2, sh_degree=1, seconds=400.0, megabytes=0.5, notes=("budget.seconds: less than it takes",))

    def opened(*arguments: Any) -> Any:
        now[0] += 30
        return open_scene(*arguments)

    def scale(*_: Any, spent: float) -> float:
        spent_at["scale"] = spent
        return 0.5

    def fitted(scene: Scene, config: ReconstructConfig, *, spent: float, **options: Any) -> Reconstruction:
        spent_at["fit"] = spent
        now[0] += 1000
        short = OptimizeConfig(steps=2, shrinks=(1,), shares=(1.0,), sh_degree=1)
        made = reconstruct(scene, replace(config, budget=ReconstructBudget(), optimize=short), **options)
        return replace(made, plan=plan, elapsed=500.0)

    def saved(*arguments: Any, **options: Any) -> None:
        now[0] += 7
        save_splat(*arguments, **options)

    for name, function in {"_open": opened, "choose_scale": scale, "reconstruct": fitted, "save_splat": saved}.items():
        monkeypatch.setattr(command, name, function)
    for module in (cli, command):
        monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    words = ["holdout=3", "seeds.voxel=0.15", "budget.seconds=506", "budget.megabytes=9"]
    assert cli.main(["reconstruct", str(room), f"out={tmp_path / 'out'}", *words]) == 0
    assert spent_at == {"scale": 30, "fit": 60}
    results = results_of(tmp_path / "out")
    budget = results["budget"]
    assert budget["chosen"] == {"image_scale": 0.5, "steps": 2, "sh_degree": 1}
    assert budget["predicted"] == {"seconds": 400, "megabytes": 0.5}
    assert budget["notes"] == list(plan.notes)
    assert budget["measured"]["seconds"] == 507
    printed = capsys.readouterr()
    assert (
        "photographs of 120×90 are looked at 0.5 times as large, because of budget.seconds=506 (data.image_scale"
        in (" ".join(printed.out.split()))
    )
    assert "budget.seconds: the limit is 506, and it became 507" in printed.err
