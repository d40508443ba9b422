"""Every write of every command, and a fault at each: what is lost, and what is said.

    python bench/faults.py [--cases fuse train …] [--faults kill tear full error short two] [--jobs 2] [--every 1]
    python bench/faults.py --kills 25 --scene SCENE [--cases fuse train reconstruct] [--seed 0]

The calls of each command that change files (open, write, rename, unlink, fsync …) are counted. Then the command is run
once for each of them and each fault: killed (SIGKILL) before the call, or in the middle of it; a disk that is full from
that call on; one error (EIO) at it; a write that writes half of what it was given. After each, out= holds whole
results, the earlier ones or nothing; an error is one line that names the file; and the same command, given again, ends
with what a run without a fault writes, and leaves nothing else. `--faults inputs`: each file that is read is refused,
gone, cut off or unreadable as it is opened. `--faults two`: the run stands still before each of its writes while a
second one, with other settings where the case has some, runs in the same folder; the results are of one of the two.
`tests/faults` does the same with a sample of the calls.

With --kills, commands of real size on a labeled RGB-D scene are killed at random moments instead: each is run once to
its end, then again, killed (SIGKILL) after a random share of the time that it took, until the kills are used up, and
then to its end. Results must be the same arrays to the last bit.
"""

import argparse
import multiprocessing
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from chat_server import answer, serving
from fault_checks import Checker, Pairs
from fault_commands import CASES, EXHAUSTIVE
from fault_runs import CUT, DENY, FULL, HALT, IO_ERROR, KILL, READ_ERROR, SHORT, SHORT_FULL, TEAR, VANISH, fault_server
from json_option import add_json_option, write_figures
from safetensors.numpy import load_file

from gsencoder.data.splats.files import load_splat

FAULTS = {"kill": (KILL,), "tear": (TEAR,), "full": (FULL, SHORT_FULL), "error": (IO_ERROR,), "short": (SHORT,)}
FAULTS |= {"inputs": (DENY, VANISH, CUT, READ_ERROR), "two": (HALT,)}


def run_case(given: tuple[str, tuple[str, ...], int, bool]) -> tuple[str, int, Counter[str], list[str], float]:
    """Puts faults into a case: its name, the number of its calls, faults by kind, what did not hold, and seconds."""
    name, faults, every, over = given
    began, done, wrong = time.perf_counter(), Counter[str](), list[str]()
    with (
        tempfile.TemporaryDirectory(prefix="gsencoder_faults_") as folder,
        serving(answer("fine")) as chat,
        fault_server(Path(folder)) as server,
    ):
        assert server is not None, "needs a C compiler, and Linux"
        checker = Checker(server, Path(folder), name, chat.url)
        calls = checker.reference.calls
        pairs = Pairs(checker) if "two" in faults else None
        for kind in faults:
            for action in FAULTS[kind]:
                for call in (checker.count_inputs() if kind == "inputs" else calls)[::every]:
                    if action in (TEAR, SHORT, SHORT_FULL) and call.size < 2:
                        continue
                    if kind == "inputs":
                        found = checker.check_input(call.number, action)
                    elif pairs is not None and action == HALT:
                        found = pairs.check(call.number, over=over)
                    else:
                        found = checker.check(call.number, action)
                    if over and action == KILL:
                        found += [
                            f"over earlier results: {each}" for each in checker.check(call.number, action, over=True)
                        ]
                        done["kill"] += 1
                    done[kind] += 1
                    wrong += found
                    for line in found:
                        print(line, file=sys.stderr, flush=True)
    return name, len(calls), done, wrong, time.perf_counter() - began


def large_commands(scene: Path) -> dict[str, tuple[list[str], str]]:
    """The words of each case, without out=, and the file that holds its result."""
    small = ["model.transformer.encoder_channels=[32,32,32,32,32]", "model.transformer.decoder_channels=[32,32,32,32]"]
    model = ["teacher=dinov2_s14", "teacher.size=224", "seeds.voxel=0.04", "fusion.views=12"]
    train = [
        "train.steps=40",
        "train.warmup=2",
        "train.checkpoint_every=1",
        "sampling.gaussians=4000",
        "seeds.voxel=0.05",
        *small,
    ]
    fit = ["optimize.steps=60", "checkpoint_every=1", "seeds.voxel=0.05", "data.image_scale=0.5"]
    words = "teacher.words=clip_vitb32_names.npz"
    return {
        "fuse": (["fuse", str(scene), *model], "features.safetensors"),
        "train": (["train", str(scene), words, "tensorboard=false", *train], "encoder.safetensors"),
        "reconstruct": (["reconstruct", str(scene), *fit], "splat.ply"),
    }


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    if path.suffix == ".ply":
        splat = load_splat(path)
        return {name: getattr(splat, name) for name in ("means", "quats", "scales", "opacities", "sh")}
    return dict(load_file(path))


def run_to_its_end(words: list[str], out: Path, kills: int, seconds: float, rng: random.Random) -> int:
    """Kills a run N times, and then lets it end; how many of the kills met a run that was still at work."""
    done = 0
    command = [sys.executable, "-m", "gsencoder", *words, f"out={out}", "quiet=true"]
    while done < kills:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        time.sleep(rng.uniform(0.05, 1.0) * seconds)
        if process.poll() is not None:
            assert process.returncode == 0, process.stderr.read().decode() if process.stderr else ""
            break
        process.kill()
        process.wait()
        if out.exists():
            # It came after the results, which are whole or not there: the caller compares them.
            break
        done += 1
    if not out.exists():
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return done


def random_kills(scene: Path, kills: int, seed: int, names: list[str]) -> dict[str, int]:
    """How many kills met each case.

    Raises:
        AssertionError: a result differs from that of a run that nobody killed.
    """
    rng, left = random.Random(seed), kills
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cases = {case: large_commands(scene)[case] for case in names}
        references, seconds = {}, {}
        for case, (words, result) in cases.items():
            began = time.perf_counter()
            run_to_its_end(words, folder / "whole" / case, 0, 0.0, rng)
            references[case], seconds[case] = arrays_of(folder / "whole" / case / result), time.perf_counter() - began
        counts, number = dict.fromkeys(cases, 0), 0
        while left:
            case = list(cases)[number % len(cases)]
            words, result = cases[case]
            out = folder / str(number) / case
            out.parent.mkdir()
            done = run_to_its_end(words, out, min(left, 3), seconds[case], rng)
            left, number, counts[case] = left - done, number + 1, counts[case] + done
            got = arrays_of(out / result)
            assert got.keys() == references[case].keys()
            for array in got:
                np.testing.assert_array_equal(got[array], references[case][array], err_msg=f"{case}: {array}")
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="*")
    parser.add_argument("--faults", nargs="*", default=list(FAULTS), choices=list(FAULTS))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--every", type=int, default=1, help="take every N-th call")
    parser.add_argument("--over", action="store_true", help="kill runs that replace earlier results as well")
    parser.add_argument("--kills", type=int, default=0, help="kills at random moments, in place of all this")
    parser.add_argument("--scene", type=Path, help="what commands that are killed at random read")
    parser.add_argument("--seed", type=int, default=0)
    add_json_option(parser)
    given = parser.parse_args()
    if bool(given.kills) != bool(given.scene):
        parser.error("--kills and --scene go together")
    known = list(large_commands(given.scene.resolve())) if given.scene else [*CASES, *EXHAUSTIVE]
    cases = given.cases or known
    if wrong := [name for name in cases if name not in known]:
        parser.error(f"--cases: no case {wrong[0]!r}; there are {', '.join(known)}")
    if given.kills:
        counts = random_kills(given.scene.resolve(), given.kills, given.seed, cases)
        write_figures(given.json, counts)
        print(f"{given.kills} kills ({', '.join(f'{case} {count}' for case, count in counts.items())}): nothing lost")
        return
    total, calls, lost = Counter[str](), 0, 0
    jobs = [(name, tuple(given.faults), given.every, given.over) for name in cases]
    print(f"{'command':24} {'writes':>6} {'faults':>7} {'wrong':>6} {'seconds':>8}")
    with multiprocessing.get_context("spawn").Pool(given.jobs) as pool:
        for name, count, done, wrong, seconds in pool.imap_unordered(run_case, jobs):
            print(f"{name:24} {count:6} {sum(done.values()):7} {len(wrong):6} {seconds:8.0f}", flush=True)
            total, calls, lost = total + done, calls + count, lost + len(wrong)
    kinds = ", ".join(f"{kind} {number}" for kind, number in total.items())
    print(f"{len(jobs)} commands, {calls} writes; {sum(total.values())} faults ({kinds}): {lost} wrong")
    write_figures(given.json, {"writes": calls, "faults": sum(total.values()), "wrong": lost})
    sys.exit(1 if lost else 0)


if __name__ == "__main__":
    main()
