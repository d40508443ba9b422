"""A kill, a full disk and an error at the writes of commands: results are whole or not there, nothing finished is lost,
the same command given again ends as if nothing had happened, and the error is one line that names the file.

Here at a sample of the calls that change files: of each command one of each kind, drawn by its name. All of them, and
those of commands that take longer: `python bench/faults.py`.
"""

import random
from collections.abc import Callable

import pytest
from fault_checks import Checker, role
from fault_pairs import Pairs
from fault_runs import CUT, DENY, FULL, IO_ERROR, KILL, READ_ERROR, SHORT, SHORT_FULL, TEAR, VANISH

QUICK = ("encode", "train", "reconstruct", "pack as npz", "score", "questions", "repair")
"""The ways in which commands write: folders, single files, folders of state that a run continues from, logs, copies."""
ENDS = ("localize", "memory")
"""Further commands, at fewer calls."""
Checkers = Callable[[str], Checker]


def sample(checker: Checker, rng: random.Random, *, torn: bool) -> int:
    """The number of a call, drawn from those of one kind: what is called, and the file without its random parts."""
    kinds: dict[tuple[str, str], list[int]] = {}
    for call in checker.reference.calls:
        if call.size >= 2 or not torn:
            kinds.setdefault((call.name, role(call.path.replace(str(checker.folder), ""))), []).append(call.number)
    return rng.choice(rng.choice(list(kinds.values())))


@pytest.mark.parametrize("name", QUICK)
def test_no_fault_of_a_write_loses_anything_or_passes_for_a_result(name: str, checker: Checkers) -> None:
    rng, wrong = random.Random(name), []
    # Each command is killed and has a full disk; of the rarer faults it has one.
    rarer = (IO_ERROR, SHORT, SHORT_FULL)[QUICK.index(name) % 3]
    for action in (KILL, TEAR, FULL, rarer):
        number = sample(checker(name), rng, torn=action in (TEAR, SHORT, SHORT_FULL))
        wrong += checker(name).check(number, action)
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("name", ENDS)
def test_a_kill_at_the_last_write_and_a_full_disk_at_another_lose_nothing(name: str, checker: Checkers) -> None:
    last = len(checker(name).reference.calls)
    wrong = checker(name).check(last, KILL)
    wrong += checker(name).check(random.Random(name).randrange(2, last), FULL)
    assert not wrong, "\n".join(wrong)


def test_results_that_are_replaced_are_there_before_and_after_every_call(checker: Checkers) -> None:
    last = len(checker("score").reference.calls)
    wrong = [each for number in range(last - 3, last + 1) for each in checker("score").check(number, KILL, over=True)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("name", ["encode", "pack as npz", "score", "questions"])
def test_an_input_that_is_lost_on_the_way_is_one_line(name: str, checker: Checkers) -> None:
    rng = random.Random(name)
    calls, wrong = checker(name).count_inputs(), []
    for action in (DENY, VANISH, CUT, READ_ERROR):
        wrong += checker(name).check_input(rng.choice(calls).number, action)
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("name", ["train", "repair"])
def test_of_two_runs_in_one_folder_one_writes_it(name: str, checker: Checkers) -> None:
    pairs = Pairs(checker(name))
    last = len(pairs.checker.reference.calls)
    # The first has nothing before its first call, and all of its results stand before its last.
    wrong = [each for call in (1, last) for each in pairs.check(call)]
    assert not wrong, "\n".join(wrong)
