"""Readers against damaged files: how many cases end in a valid result or an InputError of one line, and which do not.

    python bench/fuzz.py OUT [--cases 1000000] [--processes N] [--kinds a.ply COLMAP …] [--seed 0]
    python bench/fuzz.py OUT --replay 'a.ply' 1234

Every kind of file that is read (bench/fuzz_samples.py) is made once, small, and changed a million times: bytes, bits,
slices, numbers and tokens of text, values of JSON. A crash is any other exception, a message of several lines, more
than ten seconds, more memory than 3 GiB, or a process that dies. Cases follow from their kind, number and seed alone.
OUT/blocks.jsonl holds what was done: a run that was stopped goes on from there. OUT/crashes.jsonl lists crashes, which
`--replay` repeats.
"""

import argparse
import json
import multiprocessing
import multiprocessing.connection
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from copy import deepcopy
from pathlib import Path
from typing import Any

BLOCK = 250
"""Cases that a process does before it says so."""
SECONDS = 10
MEMORY = 3 << 30
NUMBERS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e999",
    "1e-400",
    "99999999999999999999",
    "4294967296",
    "2147483648",
    "-0.0",
    "1.5",
    "",
    "x",
    "٣",
)
VALUES: tuple[Any, ...] = (
    *(None, True, False, -1, 0, 2**31, 2**63, 10**400, 1e308, -1e308, float("nan"), float("inf"), "", "nan", "a/../b"),
    *("\x00", "\ud800", [], {}, [[]], [None] * 3, {"a": {}}, [0] * 17, "/etc/passwd", ".", "x" * 5000),
)
WORDS = (0xFFFFFFFF, 0x7FFFFFFF, 0x80000000, 0x7F800000, 0x7FC00000, 0xFF800000, 0, 1, 0x01000000)


def changed(data: bytes, name: str, rng: random.Random) -> bytes:
    """One damaged form of a file."""
    if not data:
        return bytes(rng.randrange(256) for _ in range(rng.randrange(20)))
    kind = rng.random()
    if name.endswith(".json") and kind < 0.5:
        return _changed_json(data, rng)
    if name.endswith((".json", ".jsonl", ".txt", ".csv", ".tsv")) and kind < 0.8:
        return _changed_text(data, rng)
    made = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        if not made:
            break
        # Headers are small, and hold what the rest is read by.
        reach = min(len(made), rng.choice((64, 1024, len(made), len(made))))
        at, what = rng.randrange(reach), rng.randrange(9)
        if what == 0:
            made[at] ^= 1 << rng.randrange(8)
        elif what <= 2:
            made[at] = rng.randrange(256)
        elif what == 3:
            made[at : at + 4] = rng.choice(WORDS).to_bytes(4, rng.choice(("little", "big")))
        elif what == 4:
            made[at : at + 8] = rng.choice((*WORDS, 2**63, 2**64 - 1)).to_bytes(8, "little")
        elif what == 5:
            del made[at : at + rng.choice((1, 4, 64))]
        elif what == 6:
            made[at:at] = bytes(rng.randrange(256) for _ in range(rng.choice((1, 4, 64))))
        elif what == 7:
            other = rng.randrange(len(made))
            made[at : at + 16] = made[other : other + 16]
        else:
            del made[at if rng.random() < 0.5 else rng.randrange(len(made)) :]
    return bytes(made)


def _changed_text(data: bytes, rng: random.Random) -> bytes:
    tokens = re.split(rb"([\s,:=/\[\]{}\"]+)", data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        at, what = rng.randrange(len(tokens)), rng.randrange(5)
        if what <= 1:
            tokens[at] = rng.choice(NUMBERS).encode()
        elif what == 2:
            tokens[at] = b""
        elif what == 3:
            tokens[at] = tokens[rng.randrange(len(tokens))]
        else:
            tokens[at] = tokens[at] * rng.choice((2, 3, 1000))
    return b"".join(tokens)


def _changed_json(data: bytes, rng: random.Random) -> bytes:
    value = json.loads(data)
    for _ in range(rng.choice((1, 1, 2, 3))):
        holder: Any = [value]
        key: Any = 0
        while isinstance(holder[key], (dict, list)) and holder[key] and rng.random() < 0.85:
            holder = holder[key]
            key = rng.choice(list(holder)) if isinstance(holder, dict) else rng.randrange(len(holder))
        what = rng.randrange(6)
        if what == 0 and holder[key] is not value:
            holder.pop(key)
        elif what == 1 and isinstance(holder[key], float):
            holder[key] = holder[key] * rng.choice((-1, 1e6, 1e-6, 1e30))
        elif what == 2 and isinstance(holder, list) and holder[key] is not value:
            holder.append(deepcopy(holder[key]))
        elif holder[key] is value:
            value = deepcopy(rng.choice(VALUES))
        else:
            holder[key] = deepcopy(rng.choice(VALUES))
    return json.dumps(value).encode("utf-8", "surrogatepass")


class Slow(Exception):
    """A case took too long."""


def _late(*_: object) -> None:
    raise Slow


class Reader:
    """The samples of a kind in a folder of their own, one case after the other."""

    def __init__(self, kind: str, folder: Path) -> None:
        from fuzz_samples import KINDS, trust_checksums

        self.kind = kind
        self.sample = KINDS[kind](folder)
        self.sound = [path.read_bytes() for path in self.sample.files]
        self.sample.read()
        self._undo = trust_checksums() if self.sample.trusted else lambda: None

    def close(self) -> None:
        self._undo()

    def case(self, number: int, seed: int) -> tuple[str, str]:
        """What a case ended in (read, refused or crash), and of a crash what it was."""
        from gsencoder.core.errors import InputError

        rng = random.Random(f"{self.kind} {number} {seed}")
        chosen = rng.randrange(len(self.sound))
        path, data = self.sample.files[chosen], self.sound[chosen]
        path.write_bytes(changed(data, path.name, rng))
        signal.alarm(SECONDS)
        try:
            self.sample.read()
        except InputError as error:
            bad = "\n" in str(error) or len(str(error)) > 2000
            return ("crash", f"a message of several lines: {str(error)[:300]!r}") if bad else ("refused", "")
        except Slow:
            return "crash", f"more than {SECONDS} s"
        except BaseException as error:
            # Whatever it is, it is what is looked for.
            if isinstance(error, KeyboardInterrupt):
                raise
            place = traceback.extract_tb(error.__traceback__)[-1]
            ours = [each for each in traceback.extract_tb(error.__traceback__) if "gsencoder/" in each.filename]
            where = f"{ours[-1].filename.rsplit('gsencoder/', 1)[1]}:{ours[-1].lineno}" if ours else place.filename
            return "crash", f"{type(error).__name__} at {where}: {str(error)[:200]}"
        finally:
            signal.alarm(0)
            path.write_bytes(data)
        return "read", ""


def work(pipe: Any, here: Any, seed: int) -> None:
    """A process: blocks of cases come through the pipe, and counts go back. `here` holds the case in hand."""
    os.environ["OMP_NUM_THREADS"] = "1"
    sys.path.insert(0, str(Path(__file__).parent))
    warnings.simplefilter("ignore")
    import torch

    torch.set_num_threads(1)
    signal.signal(signal.SIGALRM, _late)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    reader, folder = None, Path(tempfile.mkdtemp(dir=memory))
    # What is printed to the descriptor by libraries about bad files.
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 2)
    try:
        while (block := pipe.recv()) is not None:
            kind, start, count = block
            if reader is None or reader.kind != kind:
                if reader is not None:
                    reader.close()
                shutil.rmtree(folder)
                folder.mkdir()
                resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
                reader = Reader(kind, folder)
                used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
                resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, resource.RLIM_INFINITY))
            counts, crashes, began = {"read": 0, "refused": 0, "crash": 0}, [], time.perf_counter()
            for number in range(start, start + count):
                here.value = number
                ended, why = reader.case(number, seed)
                counts[ended] += 1
                if why:
                    crashes.append((number, why))
            pipe.send((counts, crashes, time.perf_counter() - began))
    except BaseException:
        pipe.send(traceback.format_exc())
        raise
    finally:
        shutil.rmtree(folder, ignore_errors=True)


class Worker:
    """A process and the block that it has in hand."""

    def __init__(self, seed: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.here = context.Value("q", -1, lock=False)
        self.process = context.Process(target=work, args=(theirs, self.here, seed), daemon=True)
        self.process.start()
        theirs.close()
        self.block: tuple[str, int, int] | None = None


def run(out: Path, kinds: list[str], cases: int, processes: int, seed: int) -> int:
    """Does the blocks that are left, and returns how many crashes there are in all."""
    out.mkdir(parents=True, exist_ok=True)
    done: dict[str, set[int]] = {kind: set() for kind in kinds}
    totals, before = {"read": 0, "refused": 0, "crash": 0}, 0.0
    blocks, crashes = out / "blocks.jsonl", out / "crashes.jsonl"
    if blocks.exists():
        for line in blocks.read_text().splitlines():
            row = json.loads(line)
            if row["seed"] == seed and row["kind"] in done:
                done[row["kind"]].add(row["start"])
                totals = {name: totals[name] + row[name] for name in totals}
                before += row["seconds"]
    each = -(-cases // len(kinds) // BLOCK)
    left = [(kind, start * BLOCK, BLOCK) for kind in kinds for start in range(each) if start * BLOCK not in done[kind]]
    print(f"{len(kinds)} kinds, {each * BLOCK:,} cases each, {len(left) * BLOCK:,} left; {processes} processes")
    left.reverse()
    workers, began = [Worker(seed) for _ in range(processes)], time.perf_counter()
    said, ran = began, 0

    def note(block: tuple[str, int, int], counts: dict[str, int], found: list[tuple[int, str]], seconds: float) -> None:
        with crashes.open("a") as file:
            for number, why in found:
                print(f"CRASH {block[0]} {number}: {why}")
                file.write(json.dumps({"kind": block[0], "case": number, "seed": seed, "why": why}) + "\n")
        with blocks.open("a") as file:
            row = {"kind": block[0], "start": block[1], "seed": seed, **counts, "seconds": round(seconds, 3)}
            file.write(json.dumps(row) + "\n")

    while left or any(worker.block for worker in workers):
        for worker in workers:
            if worker.block is None and left:
                worker.block = left.pop()
                worker.pipe.send(worker.block)
        ready = multiprocessing.connection.wait([worker.pipe for worker in workers if worker.block], timeout=5)
        for place, worker in enumerate(workers):
            if worker.pipe not in ready or worker.block is None:
                continue
            kind = worker.block[0]
            try:
                answer = worker.pipe.recv()
                if isinstance(answer, str):
                    raise RuntimeError(
                        f"{kind}, case {worker.here.value}: not a reader failed, but this program:\n{answer}"
                    )
                counts, found, seconds = answer
                note(worker.block, counts, found, seconds)
                worker.block = None
            except (EOFError, ConnectionError):
                # The reader took the process with it; the rest of the block is left out.
                worker.process.join()
                at = worker.here.value
                counts = {"read": 0, "refused": 0, "crash": 1}
                note(worker.block, counts, [(at, f"the process died ({worker.process.exitcode})")], 0.0)
                workers[place] = Worker(seed)
            ran += sum(counts.values())
            totals = {name: totals[name] + counts[name] for name in totals}
        if time.perf_counter() - said > 30:
            said = time.perf_counter()
            print(
                f"{sum(totals.values()):,} cases, {ran / (said - began):.0f} a second, {totals['crash']} crashes",
                flush=True,
            )
    for worker in workers:
        worker.pipe.send(None)
        worker.process.join()
    seconds = max(time.perf_counter() - began, 1e-9)
    print(
        f"{sum(totals.values()):,} cases of {len(kinds)} kinds: {totals['read']:,} read, {totals['refused']:,} "
        f"refused, {totals['crash']} crashes; {ran:,} in {seconds:.0f} s here, {ran / seconds:.0f} a second"
    )
    return totals["crash"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--cases", type=int, default=1_000_000, help="in all")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--kinds", nargs="*", default=[], help="whose names begin so; all by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--replay", nargs=2, metavar=("KIND", "CASE"), help="repeat one case, with its traceback")
    options = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parent))
    from fuzz_samples import KINDS

    if options.replay:
        kind, number = options.replay[0], int(options.replay[1])
        warnings.simplefilter("ignore")
        signal.signal(signal.SIGALRM, _late)
        with tempfile.TemporaryDirectory() as folder:
            reader = Reader(kind, Path(folder))
            rng = random.Random(f"{kind} {number} {options.seed}")
            chosen = rng.randrange(len(reader.sound))
            path = reader.sample.files[chosen]
            path.write_bytes(changed(reader.sound[chosen], path.name, rng))
            print(f"{path.name}: {path.read_bytes()[:300]!r}")
            reader.sample.read()
        return
    kinds = [kind for kind in KINDS if not options.kinds or kind.startswith(tuple(options.kinds))]
    if not kinds or options.cases < 1 or options.processes < 1:
        parser.error(f"--kinds, --cases, --processes: expected one at least; kinds are {', '.join(KINDS)}")
    sys.exit(bool(run(options.out, kinds, options.cases, options.processes, options.seed)))


if __name__ == "__main__":
    main()
