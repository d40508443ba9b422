"""Budgets of a run: each promise has its line or its warning, and the summary holds what was promised and realised."""

from dataclasses import dataclass

import pytest

from gsencoder.app.output import Summary
from gsencoder.app.summary import report_choice, report_promises
from gsencoder.core.errors import SceneWarning
from gsencoder.core.settings import Budget


@dataclass(frozen=True, slots=True, kw_only=True)
class WholeBudget(Budget):
    error: float | None = None
    seconds: float | None = None
    megabytes: float | None = None


def test_a_promise_that_is_kept_has_a_line_one_that_is_broken_a_warning_and_one_that_is_not_measured_says_so() -> None:
    summary = Summary("encode", {})
    with pytest.warns(SceneWarning, match="^error first$"):
        report_choice(
            summary, "room", {"rank": 4}, predicted={"error": None, "seconds": 1.9}, notes=["error first"], quiet=True
        )
    assert summary.results["budget"] == {"chosen": {"rank": 4}, "predicted": {"seconds": 1.9}, "notes": ["error first"]}
    budget = WholeBudget(error=0.25, seconds=2.0, megabytes=1.0)
    broken = "^budget.seconds: promised 2, and it became 2.001; the summary says what was predicted$"
    with pytest.warns(SceneWarning, match=broken) as caught:
        lines = report_promises(summary, budget, {"seconds": 2.001, "megabytes": 1.0})
    assert len(caught) == 1
    assert lines == [
        "budget.error: promised 0.25, not measured (budget.check=false)",
        "budget.megabytes: promised 1, realised 1",
    ]
    assert summary.results["budget"]["promised"] == {"error": 0.25, "seconds": 2.0, "megabytes": 1.0}
    assert summary.results["budget"]["realised"] == {"seconds": 2.001, "megabytes": 1.0}


def test_a_broken_promise_of_which_nothing_was_predicted_does_not_lead_to_a_prediction() -> None:
    summary = Summary("reconstruct", {})
    report_choice(summary, "room", {}, predicted={"error": None, "megabytes": 1.0}, notes=[], quiet=True)
    with pytest.warns(SceneWarning, match="^budget.error: promised 0.25, and it became 0.3$"):
        report_promises(summary, WholeBudget(error=0.25), {"error": 0.3})
