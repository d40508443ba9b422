"""A budget of seconds for views: the first candidates are judged in any case, more seconds never judge fewer."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from asked_rooms import save_room
from rooms import room

from gsencoder.app import cli
from gsencoder.core.errors import InputError
from gsencoder.infer.views import budget as module
from gsencoder.infer.views.budget import ViewsBudget, check_views_budget, choose_views_within
from gsencoder.infer.views.choose import choose_views
from gsencoder.infer.views.selection import ViewsConfig
from gsencoder.infer.views.targets import target_of

pytestmark = pytest.mark.slow

SHELLS = ViewsConfig(source="shells", count=4, width=160, height=120)


def test_seconds_are_kept_and_more_of_them_never_judge_fewer_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, rows = room()
    assert scene.gaussians is not None
    target, now, judge = target_of("cube", scene.gaussians, rows), [0.0], module.judge_candidates

    def judged(*arguments: Any) -> Any:
        now[0] += arguments[-1].candidates
        return judge(*arguments)

    monkeypatch.setattr(module, "judge_candidates", judged)
    numbers = []
    for seconds in (4.0, 12.0, 30.0, 60.0):
        begun = now[0]
        made = choose_views_within(scene, [target], SHELLS, ViewsBudget(seconds=seconds), clock=lambda: now[0])
        assert made.predicted == made.seconds == now[0] - begun
        assert (made.seconds <= seconds) == (not made.notes)
        numbers.append(made.candidates)
    assert numbers == [8, 8, 16, 32]
    # The choice is that of so many candidates without a budget.
    plain = choose_views(scene, [target], ViewsConfig(source="shells", count=4, width=160, height=120, candidates=32))
    assert [each.name for each in plain.chosen] == [each.name for each in made.views.chosen]
    assert plain.judged == made.views.judged


def test_what_a_budget_chooses_and_what_it_cannot_are_refused() -> None:
    budget = ViewsBudget(seconds=2.0)
    with pytest.raises(InputError, match="^choose.candidates=16: is chosen by budget.seconds"):
        check_views_budget(budget, ViewsConfig(candidates=16))
    with pytest.raises(InputError, match="^choose.method=uniform: budget.seconds is for method=greedy"):
        check_views_budget(budget, ViewsConfig(method="uniform"))
    check_views_budget(ViewsBudget(), ViewsConfig(method="uniform", candidates=16))
    with pytest.raises(InputError, match="seconds: expected a number above 0"):
        ViewsBudget(seconds=0.0)


def test_as_many_candidates_are_judged_as_views_are_asked_for_with_a_budget_and_without() -> None:
    scene, rows = room()
    assert scene.gaussians is not None
    target = target_of("cube", scene.gaussians, rows)
    config = ViewsConfig(source="shells", count=12, candidates=8, judged_side=40, width=160, height=120)
    assert choose_views(scene, [target], config).judged == 12
    many = replace(config, count=70, candidates=32)
    made = choose_views_within(scene, [target], many, ViewsBudget(seconds=1e4))
    assert made.candidates == made.views.judged == choose_views(scene, [target], many).judged == 70


def test_frames_that_are_all_judged_are_the_candidates_that_are_reported() -> None:
    scene, rows = room()
    assert scene.gaussians is not None
    assert scene.views is not None
    target = target_of("cube", scene.gaussians, rows)
    few = replace(scene, views=scene.views.select([0, 3, 6]))
    config = ViewsConfig(source="frames", count=2, judged_side=40)
    assert choose_views_within(few, [target], config, ViewsBudget(seconds=1e4)).candidates == 3


def test_the_command_records_the_promise_and_warns_where_it_is_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "CANDIDATES", (4, 6))
    save_room(tmp_path / "features")
    size = ("choose.count=2", "choose.width=120", "choose.height=90", "quiet=true")
    for seconds, broken in ((1e-3, True), (1e4, False)):
        out = tmp_path / f"views {broken}"
        words = ["query=cube", f"budget.seconds={seconds}", f"out={out}", *size]
        assert cli.main(["views", str(tmp_path / "features"), *words]) == 0
        summary = json.loads((out / "summary.json").read_text())
        budget = summary["results"]["budget"]
        assert budget["promised"] == {"seconds": seconds}
        assert (budget["realised"]["seconds"] > seconds) == broken
        assert budget["chosen"] == {"candidates": 4 if broken else 6}
        assert len(summary["warnings"]) == (2 if broken else 0)
