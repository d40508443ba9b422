"""Inputs that vanish, are cut off, or cannot be read once they have been listed: one line that names the file.

Here at a sample of the files that a command opens; all of them: `python bench/faults.py --faults inputs`.
"""

import random
from pathlib import Path

import pytest
from fault_checks import Checker
from fault_runs import CUT, DENY, READ_ERROR, VANISH, FaultServer


@pytest.mark.parametrize("name", ["encode", "pack as npz", "score", "questions"])
def test_an_input_that_is_lost_on_the_way_is_one_line(name: str, server: FaultServer, tmp_path: Path) -> None:
    rng = random.Random(name)
    checker = Checker(server, tmp_path, name)
    calls, wrong = checker.count_inputs(), []
    for action in (DENY, VANISH, CUT, READ_ERROR):
        wrong += checker.check_input(rng.choice(calls).number, action)
    assert not wrong, "\n".join(wrong)
