"""Two runs in one folder at once: the results are those of one of them, and the other says in a line that it gave way.

Here the first stands still before three of its writes, drawn by the name of the command; before each of them:
`python bench/faults.py --faults two`.
"""

import random
from pathlib import Path

import pytest
from fault_checks import Checker
from fault_pairs import Pairs
from fault_runs import FaultServer


@pytest.mark.parametrize("name", ["train", "repair"])
def test_of_two_runs_in_one_folder_one_writes_it(name: str, server: FaultServer, tmp_path: Path) -> None:
    pairs = Pairs(Checker(server, tmp_path, name))
    last = len(pairs.checker.reference.calls)
    # The first has nothing before its first call, and all of its results stand before its last.
    calls = [1, random.Random(name).randrange(2, last), last]
    wrong = [each for call in calls for each in pairs.check(call)]
    assert not wrong, "\n".join(wrong)
