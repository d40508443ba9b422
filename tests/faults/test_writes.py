"""A kill, a full disk and an error at the writes of commands: results are whole or not there, nothing finished is lost,
the same command given again ends as if nothing had happened, and the error is one line that names the file.

Here at a sample of the calls that change files: of each command one of each kind, drawn by its name. All of them, and
those of commands that take longer: `python bench/faults.py`.
"""

import random
from pathlib import Path

import pytest
from fault_checks import Checker, role
from fault_pairs import Pairs
from fault_runs import CUT, DENY, FULL, IO_ERROR, KILL, READ_ERROR, SHORT, SHORT_FULL, TEAR, VANISH, Call, FaultServer

QUICK = ("encode", "train", "reconstruct", "pack as npz", "score", "questions", "repair")
"""The ways in which commands write: folders, single files, folders of state that a run continues from, logs, copies."""
ENDS = ("localize", "memory")
"""Further commands, at fewer calls."""
FAULTS = ((KILL, 2), (TEAR, 1), (FULL, 1), (SHORT_FULL, 1), (IO_ERROR, 1), (SHORT, 1))
"""How many calls have each fault."""


def sample(calls: tuple[Call, ...], folder: str, count: int, rng: random.Random, *, torn: bool) -> list[int]:
    """Numbers of calls of different kinds: what is called, and the file without its random parts."""
    kinds: dict[tuple[str, str], list[int]] = {}
    for call in calls:
        if call.size >= 2 or not torn:
            kinds.setdefault((call.name, role(call.path.replace(folder, ""))), []).append(call.number)
    return [rng.choice(numbers) for numbers in rng.sample(list(kinds.values()), min(count, len(kinds)))]


@pytest.mark.parametrize("name", QUICK)
def test_no_fault_of_a_write_loses_anything_or_passes_for_a_result(
    name: str, server: FaultServer, tmp_path: Path
) -> None:
    rng = random.Random(name)
    checker, wrong = Checker(server, tmp_path, name), []
    for action, count in FAULTS:
        torn = action in (TEAR, SHORT, SHORT_FULL)
        for number in sample(checker.reference.calls, str(tmp_path), count, rng, torn=torn):
            wrong += checker.check(number, action)
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("name", ENDS)
def test_a_kill_at_the_first_the_last_or_another_write_loses_nothing(
    name: str, server: FaultServer, tmp_path: Path
) -> None:
    checker = Checker(server, tmp_path, name)
    last, between = len(checker.reference.calls), random.Random(name).randrange(2, len(checker.reference.calls))
    wrong = [each for number in (1, between, last) for each in checker.check(number, KILL)]
    wrong += checker.check(between, FULL)
    assert not wrong, "\n".join(wrong)


def test_results_that_are_replaced_are_there_before_and_after_every_call(server: FaultServer, tmp_path: Path) -> None:
    checker = Checker(server, tmp_path, "score")
    last = len(checker.reference.calls)
    wrong = [each for number in range(last - 3, last + 1) for each in checker.check(number, KILL, over=True)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("name", ["encode", "pack as npz", "score", "questions"])
def test_an_input_that_is_lost_on_the_way_is_one_line(name: str, server: FaultServer, tmp_path: Path) -> None:
    rng = random.Random(name)
    checker = Checker(server, tmp_path, name)
    calls, wrong = checker.count_inputs(), []
    for action in (DENY, VANISH, CUT, READ_ERROR):
        wrong += checker.check_input(rng.choice(calls).number, action)
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("name", ["train", "repair"])
def test_of_two_runs_in_one_folder_one_writes_it(name: str, server: FaultServer, tmp_path: Path) -> None:
    pairs = Pairs(Checker(server, tmp_path, name))
    last = len(pairs.checker.reference.calls)
    # The first has nothing before its first call, and all of its results stand before its last.
    calls = [1, random.Random(name).randrange(2, last), last]
    wrong = [each for call in calls for each in pairs.check(call)]
    assert not wrong, "\n".join(wrong)
