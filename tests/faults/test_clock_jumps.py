"""A clock that is set back or forward by days while a command runs: results are those of a clock that runs."""

import json
from pathlib import Path

import pytest
from fault_checks import Checker, state
from fault_runs import KILL, FaultServer

from gsencoder.app.output import DISCARDED_FILE, MARKER_FILE

DAYS = 3 * 86_400
MARKERS = (MARKER_FILE, DISCARDED_FILE)


@pytest.mark.parametrize("name", ["train", "reconstruct"])
def test_results_and_the_way_on_from_a_kill_do_not_depend_on_the_time_of_day(
    name: str, server: FaultServer, tmp_path: Path
) -> None:
    checker = Checker(server, tmp_path, name)
    ref = checker.reference
    # The last one marks the state as removed, when the results are complete.
    renames = [call for call in ref.calls if call.name == "rename" and not call.path.endswith(MARKERS)]
    saved = [call.number for call in renames if ".training" in call.path] or [call.number for call in renames]
    for seconds in (-DAYS, DAYS):
        folder = checker.new()
        words = [*ref.words, f"out={folder / ref.case.out}"]
        # The clock jumps after a few readings of a run that is killed, and stands elsewhere for the one that goes on.
        killed = server.run(words, folder, at=saved[-1], action=KILL, clock=(3, seconds))
        assert killed.code == -9
        done = server.run(words, folder, clock=(0, -seconds))
        assert done.code == 0, done.lines
        assert state(folder) == ref.whole
        timings = json.loads((folder / "out" / "summary.json").read_text())["timings"]
        assert all(0 <= value < DAYS / 2 for value in timings.values())
        checker.drop(folder)
