"""What must hold after a fault: no half of a result passes for the whole, nothing finished is lost, the next run of the
same command is not disturbed, and an error is one line that names the file."""

import json
import re
import shutil
from dataclasses import dataclass, field
from pathlib import Path

from fault_commands import CASES, EXHAUSTIVE, Case, words_of
from fault_runs import (
    CUT,
    DENY,
    FULL,
    HALT,
    IO_ERROR,
    KILL,
    READ_ERROR,
    SHORT,
    SHORT_FULL,
    TEAR,
    VANISH,
    Call,
    FaultServer,
    Run,
    contents,
)

NAMES = {KILL: "kill", TEAR: "tear", FULL: "full disk", IO_ERROR: "error", SHORT: "short", SHORT_FULL: "short, full"}
NAMES |= {DENY: "refused", VANISH: "gone", CUT: "cut off", READ_ERROR: "unreadable"}
FULL_WORDS = ("no space left", "disk is full")


@dataclass
class Reference:
    """What a run without a fault leaves: a digest of each file, folders, and the calls that it made."""

    case: Case
    words: list[str]
    whole: dict[str, str]
    folders: set[str]
    calls: tuple[Call, ...]
    seconds: float
    inputs: dict[str, tuple[int, int]] = field(default_factory=dict)


class Checker:
    """Puts faults into the runs of a case and says what did not hold."""

    def __init__(self, server: FaultServer, folder: Path, name: str, url: str = "") -> None:
        """Runs the case without a fault, in the server and in a child; `url` is that of the server of chat."""
        self.server, self.folder, self.name = server, folder, name
        case = CASES.get(name) or EXHAUSTIVE[name]
        server.prepare(name)
        words = words_of(case.words, server.given)
        if case.server:
            words += [f"vlm.base_url={url}", "vlm.retries=0"]
        self._turn = 0
        self._known: dict[str, list[str]] = {}
        first = self.new()
        for warm in (True, False):
            done = server.run(
                [*words, f"out={first / case.out}", *(() if warm else ("overwrite=true",))], first, warm=warm
            )
            assert done.code == 0, (name, done.lines)
        self.drop(first)
        first = self.new()
        done = server.run([*words, f"out={first / case.out}"], first)
        assert done.code == 0, (name, done.lines)
        self.reference = Reference(case, words, state(first), folders(first), done.calls, done.seconds, self.inputs())
        self.drop(first)

    def new(self) -> Path:
        """An empty folder; the names of all are of one length, since some files hold them."""
        self._turn += 1
        path = self.folder / f"{self.name.replace(' ', '_')}-{self._turn:04}"
        path.mkdir()
        return path

    def drop(self, path: Path) -> None:
        shutil.rmtree(path)
        shutil.rmtree(path.parent / f"{path.name}.run", ignore_errors=True)

    def inputs(self) -> dict[str, tuple[int, int]]:
        """Size and time of each file that the case may read."""
        files = (path for path in self.server.given.rglob("*") if path.is_file())
        return {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in files}

    def run(self, folder: Path, *more: str, at: int = 0, action: int = 0) -> Run:
        """The command of the case in a folder."""
        words = [*self.reference.words, f"out={folder / self.reference.case.out}", *more]
        return self.server.run(words, folder, at=at, action=action)

    def run_before(self, folder: Path) -> None:
        """Leaves results that the next run is to replace."""
        assert self.run(folder).code == 0
        for each in self.reference.case.beside:
            shutil.rmtree(folder / each, ignore_errors=True)

    def check(self, at: int, action: int, *, over: bool = False) -> list[str]:
        """Puts a fault at a call; what did not hold. With `over` the run replaces earlier results."""
        ref, folder, wrong = self.reference, self.new(), []
        out = folder / ref.case.out
        more: tuple[str, ...] = ()
        earlier: dict[str, str] = {}
        if over:
            self.run_before(folder)
            if out.is_dir():
                (out / "earlier.txt").write_text("earlier")
            earlier, more = contents(out), ("overwrite=true",)
        done = self.run(folder, *more, at=at, action=action)
        call = next((each for each in done.calls if each.number == at), None)
        where = f"{self.name}: {NAMES[action]} at {at} ({call.name} {self.short(call.path, folder)})" if call else ""
        if call is None:
            self.drop(folder)
            return [f"{self.name}: call {at} was not made again"]
        stands = contents(out) if out.exists() else {}
        finished = {key.partition("/")[2] or key: value for key, value in ref.whole.items() if self.of_out(key)}
        finished = tidy(finished)
        stands = tidy(stands)
        if ref.case.several:
            # Each scene has a folder of its own; those that are not whole are not there.
            stands = {name: value for name, value in stands.items() if not name.startswith(".")}
            scenes = {name.split("/")[0] for name in stands}
            finished = {name: value for name, value in finished.items() if name.split("/")[0] in scenes}
        if stands and stands != finished and stands != tidy(earlier):
            wrong.append(f"out is neither whole nor as before: {sorted(stands.items() ^ finished.items())[:4]}")
        if over and not stands:
            wrong.append("the earlier results are lost")
        if action in (KILL, TEAR):
            if done.code != -9:
                wrong.append(f"code {done.code} and not killed: {done.error}")
        elif done.code == 0:
            if stands != finished:
                wrong.append("ended well without results")
            if action in (SHORT, SHORT_FULL) and state(folder) != ref.whole:
                wrong.append(f"ended well, and results differ: {difference(state(folder), ref.whole)}")
        else:
            wrong += self.message(done, folder, action)
            if left := [name for name in contents(folder) if ".partial-" in name or name.endswith(".tmp")]:
                wrong.append(f"temporary files are left: {sorted(map(role, left))[:4]}")
        if not ref.inputs.items() <= self.inputs().items():
            wrong.append("inputs were changed")
        # What a killed run left in hidden folders is removed by the next, whatever it is.
        left = json.dumps([tidy(hidden(contents(folder))), sorted(hidden(dict.fromkeys(folders(folder), "")))])
        if left not in self._known:
            self._known[left] = self.next_run(folder, bool(stands) and not ref.case.several)
        wrong += self._known[left]
        self.drop(folder)
        return [f"{where}: {each}" for each in wrong]

    def count_inputs(self) -> tuple[Call, ...]:
        """The files that a run opens to read, in order."""
        folder = self.new()
        words = [*self.reference.words, f"out={folder / self.reference.case.out}"]
        done = self.server.run(words, folder, reads=self.server.given)
        self.drop(folder)
        return done.calls

    def check_input(self, at: int, action: int) -> list[str]:
        """Puts a fault at the opening of an input, in a copy of all of them; what did not hold."""
        folder, wrong, ref = self.new(), [], self.reference
        # Of the same length, since some files hold paths.
        given = self.server.given.with_name("taken")
        shutil.copytree(self.server.given, given)
        words = [word.replace(str(self.server.given), str(given)) for word in ref.words]
        done = self.server.run([*words, f"out={folder / ref.case.out}"], folder, reads=given, at=at, action=action)
        call = next((each for each in done.calls if each.number == at), None)
        if call is None:
            wrong.append("the input was not opened again")
        else:
            lines = self.errors(done)
            name = call.path.rpartition("/")[2]
            if done.code == 0:
                if state(folder) != ref.whole and not any(name in line for line in done.lines):
                    wrong.append(f"ended well, other results, no word: {difference(state(folder), ref.whole)}")
            elif done.code != 2 or len(lines) != 1 or not lines[0].startswith("error: "):
                wrong.append(f"code {done.code}: " + " / ".join(lines[-3:])[-400:])
            elif name not in lines[0] and call.path.rpartition("/")[0] not in lines[0]:
                wrong.append(f"the file is not named: {lines[0]}")
            elif (folder / ref.case.out).exists() and not ref.case.several:
                wrong.append("out is there")
        self.drop(folder)
        shutil.rmtree(given)
        where = f"{self.name}: {NAMES[action]} input {at} ({self.short(call.path, given) if call else ''})"
        return [f"{where}: {each}" for each in wrong]

    def next_run(self, folder: Path, stands: bool) -> list[str]:
        ref = self.reference
        again = self.run(folder, *(("overwrite=true",) if stands else ()))
        if again.code != 0:
            return [f"the next run ended with {again.code}: {again.error}"]
        if state(folder) != ref.whole or folders(folder) != ref.folders:
            left = sorted(folders(folder) ^ ref.folders)
            return [f"the next run left something else: {difference(state(folder), ref.whole)} {left}"]
        return []

    def message(self, done: Run, folder: Path, action: int) -> list[str]:
        lines = self.errors(done)
        if done.code != 2 or len(lines) != 1 or not lines[0].startswith("error: "):
            return [f"code {done.code}: " + " / ".join(lines[-3:])[-400:]]
        wrong = []
        if str(folder) not in lines[0]:
            wrong.append(f"no file is named: {lines[0]}")
        if action in (FULL, SHORT_FULL) and not any(word in lines[0].lower() for word in FULL_WORDS):
            wrong.append(f"does not say that the disk is full: {lines[0]}")
        if ".partial-" in lines[0] or ".tmp" in lines[0]:
            wrong.append(f"a temporary name is shown: {lines[0]}")
        return wrong

    def errors(self, done: Run) -> list[str]:
        """The lines of an error: without warnings, and of several scenes without a line about each that failed, which
        the last one repeats."""
        beside = ("warning: ", "note: ", *(["failed: "] if self.reference.case.several else []))
        return [line for line in done.lines if not line.startswith(beside)]

    def of_out(self, key: str) -> bool:
        return key.split("/")[0] == self.reference.case.out

    @staticmethod
    def short(path: str, folder: Path) -> str:
        """A path without what differs in each run."""
        return role(path.replace(str(folder), ""))


def role(path: str) -> str:
    """A path without random parts, so that equal writes of two runs have one name."""
    path = re.sub(r"[.]partial-[0-9a-f]{8}", ".partial", path)
    path = re.sub(r"[.][0-9a-f]{12}[.]tmp", ".tmp", path)
    path = re.sub(r"(/[.][^/]*)[.]\d+$", r"\1.PID", path)
    return re.sub(r"tfevents[^/]*", "tfevents", path)


def hidden(files: dict[str, str]) -> dict[str, str]:
    """Files without what lies in the hidden folders of killed runs, and without random names."""
    return {
        re.sub(r"([.]partial)/.*", r"\1", role(f"/{name}")): v for name, v in files.items() if ".partial-" not in name
    } | ({"a hidden folder": ""} if any(".partial-" in name for name in files) else {})


def tidy(files: dict[str, str]) -> dict[str, str]:
    """Digests without those of pictures of time and logs of TensorBoard, which differ in each run."""
    files = {re.sub(r"tfevents[^/]*", "tfevents", name): value for name, value in files.items()}
    unlike = ("report.html", "tfevents", "tradeoff.csv", "scenes.csv", "tradeoff.png", "tradeoff.html", "page.html")
    return {name: "" if name.endswith(unlike) else value for name, value in files.items()}


def state(folder: Path) -> dict[str, str]:
    return tidy(contents(folder))


def folders(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_dir()}


def difference(first: dict[str, str], second: dict[str, str]) -> list[str]:
    return sorted(name for name in {*first, *second} if first.get(name) != second.get(name))[:4]


@dataclass
class Pairs:
    """Two runs of a case in one folder: one stands still before one of its writes while the other runs. The results are
    those of one of the two, and the other run says in one line that it gave way."""

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
            checker.run_before(folder)
            more = ("overwrite=true",)
        words = [*ref.words, *more, f"out={folder / ref.case.out}"]
        first = checker.server.run(words, folder, at=at, action=HALT, meanwhile=[*words, *ref.case.other])
        call = next((each for each in first.calls if each.number == at), None)
        second, wrong = first.other, []
        if call is None or second is None:
            checker.drop(folder)
            return [f"{checker.name}: call {at} was not made again"]
        where = f"{checker.name}: two runs, one before {at} ({call.name} {checker.short(call.path, folder)})"
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
            unlike = [[role(name) for name in difference(stands, each)] for each in whole.values()]
            wrong.append(f"what stands is of neither run: {unlike}; {well}")
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
