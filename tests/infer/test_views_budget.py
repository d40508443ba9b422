"""Budgets of views: the first candidates are judged in any case, more seconds never judge fewer; what is refused; and
what the command says of each limit."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from asked_rooms import save_room
from rooms import room

from gsencoder.app import main as cli
from gsencoder.core.errors import InputError
from gsencoder.infer.views import budget as module
from gsencoder.infer.views.budget import ViewsBudget, check_views_budget, choose_views_within
from gsencoder.infer.views.choose import choose_views
from gsencoder.infer.views.targets import ViewsConfig, target_of

pytestmark = pytest.mark.slow

SHELLS = ViewsConfig(source="shells", count=4, judged_side=40, width=80, height=60)


def test_seconds_are_kept_and_more_of_them_never_judge_fewer_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, rows = room(step=0.12)
    target, now, score = target_of("cube", scene.gaussians, rows), [0.0], module.score_candidates

    def scored(*arguments: Any) -> Any:
        now[0] += arguments[2].candidates
        return score(*arguments)

    monkeypatch.setattr(module, "score_candidates", scored)
    numbers = []
    for seconds in (4.0, 30.0, 60.0):
        begun = now[0]
        made = choose_views_within(scene, [target], SHELLS, ViewsBudget(seconds=seconds), clock=lambda: now[0])
        assert made.predicted["seconds"] == made.seconds == now[0] - begun
        assert (made.seconds <= seconds) == (not made.notes)
        numbers.append(made.chosen["candidates"])
    assert numbers == [8, 16, 32]
    # The choice is that of so many candidates without a budget.
    plain = choose_views(scene, [target], replace(SHELLS, candidates=32))
    assert [each.name for each in plain.chosen] == [each.name for each in made.views.chosen]
    assert plain.judged == made.views.judged


def test_what_a_budget_chooses_and_what_it_cannot_are_refused() -> None:
    budget = ViewsBudget(seconds=2.0)
    with pytest.raises(InputError, match="^choose.candidates=16: is chosen by budget.seconds"):
        check_views_budget(budget, ViewsConfig(candidates=16))
    with pytest.raises(InputError, match="^choose.method=uniform: budget.seconds is for method=greedy"):
        check_views_budget(budget, ViewsConfig(method="uniform"))
    for name, value in (("error", 0.1), ("megabytes", 2.0)):
        with pytest.raises(InputError, match=f"^choose.method=uniform: budget.{name} is for method=greedy"):
            check_views_budget(ViewsBudget(**{name: value}), ViewsConfig(method="uniform"))
    with pytest.raises(InputError, match="^choose.count=4: is chosen by budget.error"):
        check_views_budget(ViewsBudget(error=0.1), ViewsConfig(count=4))
    for name in ("width", "height", "frame_side"):
        with pytest.raises(InputError, match=f"^choose.{name}=300: is chosen by budget.megabytes"):
            check_views_budget(ViewsBudget(megabytes=2.0), ViewsConfig(**{name: 300}))
    # Beside a limit that does not choose it an option can be set.
    check_views_budget(ViewsBudget(error=0.1, seconds=3.0), ViewsConfig(candidates=16, width=300))
    check_views_budget(ViewsBudget(megabytes=2.0), ViewsConfig(candidates=16, count=4))
    check_views_budget(ViewsBudget(), ViewsConfig(method="uniform", candidates=16))


def test_as_many_candidates_are_judged_as_views_are_asked_for_with_a_budget_and_without(monkeypatch):
    monkeypatch.setattr(module, "CANDIDATES", (4, 8))
    scene, rows = room(step=0.12)
    target = target_of("cube", scene.gaussians, rows)
    config = ViewsConfig(source="shells", count=12, candidates=8, judged_side=40, width=80, height=60)
    assert choose_views(scene, [target], config).judged == 12
    many = replace(config, count=36, candidates=32)
    made = choose_views_within(scene, [target], many, ViewsBudget(seconds=1e4))
    assert made.chosen["candidates"] == made.views.judged == choose_views(scene, [target], many).judged == 36


def test_frames_that_are_all_judged_are_the_candidates_that_are_reported() -> None:
    scene, rows = room(step=0.12)
    target = target_of("cube", scene.gaussians, rows)
    few = replace(scene, views=scene.views.select([0, 3, 6]))
    config = ViewsConfig(source="frames", count=2, judged_side=40)
    assert choose_views_within(few, [target], config, ViewsBudget(seconds=1e4)).chosen == {"candidates": 3}


def test_the_command_records_the_limit_and_warns_where_it_is_broken(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "CANDIDATES", (4, 6))
    save_room(tmp_path / "features", step=0.12)
    size = ("choose.count=2", "choose.width=120", "choose.height=90", "quiet=true")
    for seconds, broken in ((1e-3, True), (1e4, False)):
        out = tmp_path / f"views {broken}"
        words = ["query=cube", f"budget.seconds={seconds}", f"out={out}", *size]
        assert cli.main(["views", str(tmp_path / "features"), *words]) == 0
        summary = json.loads((out / "summary.json").read_text())
        budget = summary["results"]["budget"]
        assert budget["limits"] == {"seconds": seconds}
        assert (budget["measured"]["seconds"] > seconds) == broken
        assert budget["chosen"] == {"candidates": 4 if broken else 6}
        assert len(summary["warnings"]) == (2 if broken else 0)


def test_the_command_measures_error_and_megabytes_and_says_both_numbers_where_they_are_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    save_room(tmp_path / "features", step=0.12)

    def views(name: str, *words: str) -> tuple[int, dict[str, Any]]:
        out = tmp_path / name
        words = ("query=cube", "choose.source=frames", "choose.candidates=6", *words)
        code = cli.main(["views", str(tmp_path / "features"), *words, f"out={out}"])
        return code, json.loads((out / "summary.json").read_text()) if code == 0 else {}

    _, kept = views("kept", "budget.error=0.2", "budget.megabytes=0.1")
    budget = kept["results"]["budget"]
    files = list((tmp_path / "kept").glob("view_*.png"))
    assert budget["limits"] == {"error": 0.2, "megabytes": 0.1}
    assert budget["measured"]["megabytes"] == sum(file.stat().st_size for file in files) / 1e6 <= 0.1
    assert 0 < budget["measured"]["error"] <= 0.2
    assert budget["chosen"]["count"] == len(files) == len(kept["results"]["views"])
    assert kept["warnings"] == []
    assert f"budget.error: limit 0.2, measured {budget['measured']['error']:.4g}" in capfd.readouterr().out.replace(
        "\n", " "
    )
    # The same limit, not measured.
    _, unmeasured = views("unmeasured", "budget.error=0.2", "budget.check=false")
    assert unmeasured["results"]["budget"]["measured"] == {}
    monkeypatch.setattr(module, "measured_errors", lambda *_, **__: (0.75,))
    _, broken = views("broken", "budget.error=0.2", "budget.megabytes=0.0001")
    conflict, error, megabytes = broken["warnings"]
    assert conflict.endswith("more than budget.megabytes=0.0001; budget.error comes first")
    assert error.startswith("budget.error: the limit is 0.2, and it became 0.75")
    assert megabytes.startswith("budget.megabytes: the limit is 0.0001, and it became 0.")
    code, _ = views("refused", "budget.megabytes=0.0001")
    assert code != 0
    assert not (tmp_path / "refused").exists()
