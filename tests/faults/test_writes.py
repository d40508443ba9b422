"""A kill, a full disk and an error at the writes of commands: results are whole or not there, nothing finished is lost,
the same command given again ends as if nothing had happened, and the error is one line that names the file.

Here at a sample of the calls that change files, drawn by the name of the command. All of them, and those of all
commands: `python bench/faults.py`.
"""

import random
from collections.abc import Callable

import pytest
from fault_checks import Checker, Pairs, role
from fault_runs import CUT, DENY, FULL, IO_ERROR, KILL, READ_ERROR, SHORT, SHORT_FULL, TEAR, VANISH

FAULTS = {
    "train": (KILL, TEAR), "reconstruct": (KILL, IO_ERROR), "pack as npz": (TEAR, FULL), "score": (KILL, SHORT),
    "repair": (KILL, FULL),
}  # fmt: skip
"""Of each way in which commands write: folders of state that a run continues from, logs, folders, single files."""
LOST_INPUTS = {"pack as npz": (DENY, VANISH), "score": (CUT, READ_ERROR)}
Checkers = Callable[[str], Checker]


def sample(checker: Checker, rng: random.Random, *, torn: bool) -> int:
    """The number of a call, drawn from those of one kind: what is called, and the file without its random parts."""
    kinds: dict[tuple[str, str], list[int]] = {}
    for call in checker.reference.calls:
        if call.size >= 2 or not torn:
            kinds.setdefault((call.name, role(call.path.replace(str(checker.folder), ""))), []).append(call.number)
    return rng.choice(rng.choice(list(kinds.values())))


@pytest.mark.parametrize("name", FAULTS)
def test_no_fault_loses_anything_or_passes_for_a_result(name: str, checker: Checkers) -> None:
    rng, wrong = random.Random(name), []
    for action in FAULTS[name]:
        number = sample(checker(name), rng, torn=action in (TEAR, SHORT, SHORT_FULL))
        wrong += checker(name).check(number, action)
    if name in LOST_INPUTS:
        calls = checker(name).count_inputs()
        for action in LOST_INPUTS[name]:
            wrong += checker(name).check_input(rng.choice(calls).number, action)
    last = len(checker(name).reference.calls)
    if name == "score":
        # Results that are replaced are there before and after every call.
        for number in range(last - 3, last + 1):
            wrong += checker(name).check(number, KILL, over=True)
    if name in ("train", "repair"):
        # Of two runs in one folder one writes it. The first has nothing before its first call, and all of its results
        # stand before its last.
        pairs = Pairs(checker(name))
        wrong += [*pairs.check(1), *pairs.check(last)]
    assert not wrong, "\n".join(wrong)
