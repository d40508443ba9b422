"""Two runs of a command in one folder: one stands still before one of its writes while the other runs. The results are
those of one of the two, and the other run says in one line that it gave way."""

import shutil
from dataclasses import dataclass

from fault_checks import Checker, folders, role, state
from fault_runs import HALT, Run


@dataclass
class Pairs:
    """Pairs of runs of a case."""

    checker: Checker

    def __post_init__(self) -> None:
        """Runs the case alone with the settings of the second run."""
        checker, case = self.checker, self.checker.reference.case
        folder = checker.new()
        done = checker.run(folder, *case.other)
        assert done.code == 0, (checker.name, done.lines)
        self._second = state(folder)
        assert not case.other or self._second != checker.reference.whole, "other settings, and the same results"
        checker.drop(folder)

    def check(self, at: int, *, over: bool = False) -> list[str]:
        """Lets the first run stand still before a call, and runs the second; what did not hold. With `over` both
        replace results that are there."""
        checker, ref = self.checker, self.checker.reference
        folder = checker.new()
        more: tuple[str, ...] = ()
        if over:
            assert checker.run(folder).code == 0
            for each in ref.case.beside:
                shutil.rmtree(folder / each, ignore_errors=True)
            more = ("overwrite=true",)
        words = [*ref.words, *more, f"out={folder / ref.case.out}"]
        first = checker.server.run(words, folder, at=at, action=HALT, meanwhile=[*words, *ref.case.other])
        call = next((each for each in first.calls if each.number == at), None)
        where = (
            f"{checker.name}: two runs, one before {at} ({call.name} {checker.short(call.path, folder)})"
            if call
            else ""
        )
        second, wrong = first.other, []
        if call is None or second is None:
            checker.drop(folder)
            return [f"{checker.name}: call {at} was not made again"]
        well = [name for name, run in (("first", first), ("second", second)) if run.code == 0]
        # The runs of several scenes share them; other results are replaced only where this is asked.
        together = over or ref.case.several
        if not well or (len(well) == 2 and not together):
            wrong.append(f"ended well: {well or 'neither'}: {first.error} / {second.error}")
        for run in (first, second):
            wrong += self._refusal(run)
        stands = state(folder)
        whole = {"first": ref.whole, "second": self._second}
        if not any(stands == whole[name] for name in well):
            names = [name for name in sorted({*stands, *ref.whole}) if stands.get(name) != ref.whole.get(name)]
            also = [name for name in sorted({*stands, *self._second}) if stands.get(name) != self._second.get(name)]
            wrong.append(f"what stands is of neither run: {[role(name) for name in names[:4]]}, {also[:4]}; {well}")
        if folders(folder) - ref.folders:
            wrong.append(f"left: {sorted(role(name) for name in folders(folder) - ref.folders)}")
        checker.drop(folder)
        return [f"{where}: {each}" for each in wrong]

    @staticmethod
    def _refusal(run: Run) -> list[str]:
        lines = [line for line in run.lines if not line.startswith(("warning: ", "note: "))]
        if run.code == 0 or (run.code == 2 and len(lines) == 1 and lines[0].startswith("error: ")):
            return []
        return [f"code {run.code}: " + " / ".join(lines[-3:])[-400:]]
