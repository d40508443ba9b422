"""Small faults planted in core modules, one at a time: the share of them that the tests notice.

    python bench/mutants.py [--seed 0] [--count 5] [--modules 'data/*' …] [--functions NAMES.txt] [--out FILE]

Faults are drawn from operators, comparisons and constants. A copy of the project is mutated, never the checkout. The
test files that belong to a module run first (named like it, or importing it), then the rest of its folder. With
`--functions` faults lie in functions of these names alone, one a line, wherever they are. A fault that
makes the first ones hang counts as killed; one that outlives them, and for which the folder takes longer than
`--folder-seconds`, counts as survived. A run that was interrupted goes on where it stopped; with `--again` the
survivors in the file are judged once more.
"""

import argparse
import ast
import copy
import fnmatch
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import Queue
from tempfile import TemporaryDirectory

MODULES = (
    "geometry",
    "fusion/lift",
    "fusion/basis",
    "infer/localize",
    "infer/relevancy",
    "infer/views/choose",
    "train/losses",
    "train/samples",
    "models/grid",
    "models/plan",
    "data/seeding/depth",
    "data/readers/transforms_json",
    "reconstruct/optimize",
)
ROOT = Path(__file__).parents[1]
NOT_COPIED = shutil.ignore_patterns(".git", ".venv", "outputs", "dist", "build", ".*_cache")

SWAPS: dict[type[ast.AST], tuple[type[ast.AST], ...]] = {
    ast.Add: (ast.Sub,),
    ast.Sub: (ast.Add,),
    ast.Mult: (ast.Div,),
    ast.Div: (ast.Mult,),
    ast.FloorDiv: (ast.Mult,),
    ast.Mod: (ast.FloorDiv,),
    ast.BitAnd: (ast.BitOr,),
    ast.BitOr: (ast.BitAnd,),
    ast.And: (ast.Or,),
    ast.Or: (ast.And,),
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.GtE),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.LtE),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
}
SILENT = ("metadata", "help")
"""Keyword arguments that only people read."""


@dataclass(frozen=True)
class Mutant:
    """One fault: the expression at a place, and what stands there instead."""

    module: str
    line: int
    column: int
    before: str
    after: str

    def source(self) -> str:
        """The module with the fault."""
        tree = ast.parse((ROOT / "gsencoder" / f"{self.module}.py").read_text())

        fault = ast.parse(self.after, mode="eval").body

        def swapped(node: object) -> object:
            here = isinstance(node, ast.expr) and (node.lineno, node.col_offset) == (self.line, self.column)
            return fault if here and ast.unparse(node) == self.before else node

        for parent in ast.walk(tree):
            for name, value in ast.iter_fields(parent):
                setattr(parent, name, [*map(swapped, value)] if isinstance(value, list) else swapped(value))
        return ast.unparse(tree)


def expressions(node: ast.AST) -> Iterator[ast.expr]:
    """Expressions whose value the program uses: no annotations, decorators, error messages or help texts."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.Raise | ast.JoinedStr):
                continue
            if isinstance(child, ast.keyword) and child.arg in SILENT:
                continue
            if isinstance(child, ast.expr):
                yield child
            if isinstance(child, ast.AST):
                yield from expressions(child)


def faulty(node: ast.expr) -> Iterator[ast.AST]:
    """Every faulty version of one expression, not of its parts."""
    if isinstance(node, ast.BinOp | ast.BoolOp):
        for swap in SWAPS.get(type(node.op), ()):
            changed = copy.deepcopy(node)
            changed.op = swap()  # type: ignore[assignment]
            yield changed
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not | ast.Invert):
        yield node.operand
    elif isinstance(node, ast.Compare):
        for i, op in enumerate(node.ops):
            for swap in SWAPS.get(type(op), ()):
                changed = copy.deepcopy(node)
                changed.ops[i] = swap()  # type: ignore[assignment]
                yield changed
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield ast.Constant(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        for value in (node.value + 1, node.value - 1, node.value * 2, node.value / 2):
            if value != node.value and isinstance(value, type(node.value)):
                yield ast.Constant(value)


def draw(module: str, count: int, seed: int, functions: frozenset[str] = frozenset()) -> list[Mutant]:
    """Some faults of a module, no two at one expression, in the order of the source."""
    tree = ast.parse((ROOT / "gsencoder" / f"{module}.py").read_text())
    parts: list[ast.AST] = [tree]
    if functions:
        parts = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and node.name in functions]
    found = {(node.lineno, node.col_offset, ast.unparse(node)): node for part in parts for node in expressions(part)}
    sites = [(node, versions) for node in found.values() if (versions := list(faulty(node)))]
    rng = random.Random(f"{seed} {module}")
    drawn = [(node, rng.choice(versions)) for node, versions in rng.sample(sites, min(count, len(sites)))]
    mutants = [
        Mutant(module, node.lineno, node.col_offset, ast.unparse(node), ast.unparse(after)) for node, after in drawn
    ]
    return sorted(mutants, key=lambda each: (each.line, each.column))


def test_files(project: Path, module: str) -> tuple[list[str], list[str]]:
    """Test files that belong to a module, and the rest of its folder."""
    tests = sorted((project / "tests").glob("**/test_*.py"))
    name, stem = "gsencoder." + module.replace("/", "."), module.rpartition("/")[2]
    folder = project / "tests" / module.partition("/")[0]
    first = [path for path in tests if path.stem == f"test_{stem}" or re.search(rf"\b{name}\b", path.read_text())]
    # The file that is named like the module notices most.
    first.sort(key=lambda path: path.stem != f"test_{stem}")
    rest = [path for path in tests if folder in path.parents and path not in first]
    return [str(path.relative_to(project)) for path in first], [str(path.relative_to(project)) for path in rest]


def run_tests(folder: Path, files: list[str], limit: float) -> tuple[str, str]:
    """How the tests end, "passed", "failed" or "time limit", and the first that fails."""
    environment = {
        "GSENCODER_SHARED": str(ROOT.parent / "shared"),
        **os.environ,
        # Comes before the checkout that the environment was installed from, also in processes that tests start.
        "PYTHONPATH": str(folder),
    }
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *files]
    # A group of its own, so that processes that the tests started end with them.
    process = subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
    )
    try:
        out = process.communicate(timeout=limit)[0].decode(errors="replace")
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, 9)
        process.communicate()
        return "time limit", ""
    if process.returncode == 0:
        return "passed", ""
    if process.returncode not in (1, 2):
        raise RuntimeError(f"pytest ended with {process.returncode}:\n{out[-2000:]}")
    first = re.search(r"^(?:FAILED|ERROR) (\S+)", out, re.MULTILINE)
    return "failed", first[1] if first else "collection"


def judge(mutant: Mutant, folder: Path, seconds: float, folder_seconds: float) -> dict[str, object]:
    """Plants a fault in a copy of the project, runs the tests, and takes it out again."""
    path = folder / "gsencoder" / f"{mutant.module}.py"
    sound, start = path.read_text(), time.perf_counter()
    path.write_text(mutant.source())
    try:
        first, rest = test_files(folder, mutant.module)
        judged = "files"
        end, test = run_tests(folder, first, seconds)
        if end == "passed" and rest and folder_seconds > 0:
            end, test = run_tests(folder, rest, folder_seconds)
            judged = "folder" if end != "time limit" else "files"
            killed = end == "failed"
        else:
            killed = end != "passed"
    finally:
        path.write_text(sound)
    return {
        **asdict(mutant),
        "killed": killed,
        "judged_by": judged,
        "seconds": round(time.perf_counter() - start, 1),
        "test": test or ("time limit" if killed else ""),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=5, help="faults of each module")
    parser.add_argument(
        "--modules", nargs="+", metavar="PATTERN", help="modules below gsencoder, as fusion/basis or infer/*"
    )
    parser.add_argument("--functions", type=Path, help="a file of function names, one a line")
    parser.add_argument("--out", type=Path, help="default: outputs/mutants_SEED.jsonl")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--again", action="store_true", help="judge the survivors once more")
    parser.add_argument("--sound", action="store_true", help="the tests are known to pass without a fault")
    parser.add_argument("--seconds", type=float, default=600, help="for the test files of a module")
    parser.add_argument("--folder-seconds", type=float, default=240, help="for the rest of its folder; 0 = leave it")
    chosen = parser.parse_args()
    out: Path = chosen.out or ROOT / "outputs" / f"mutants_{chosen.seed}.jsonl"
    out.parent.mkdir(parents=True, exist_ok=True)
    known = {}
    for line in out.read_text().splitlines() if out.exists() else []:
        row = json.loads(line)
        known[Mutant(*(row[name] for name in Mutant.__dataclass_fields__))] = row
    package = ROOT / "gsencoder"
    present = [path.relative_to(package).with_suffix("").as_posix() for path in sorted(package.glob("**/*.py"))]
    patterns = chosen.modules or (["*"] if chosen.functions else MODULES)
    modules = [each for each in present if any(fnmatch.fnmatch(each, pattern) for pattern in patterns)]
    functions = frozenset(chosen.functions.read_text().split()) if chosen.functions else frozenset()
    mutants = [mutant for module in modules for mutant in draw(module, chosen.count, chosen.seed, functions)]
    due = [each for each in mutants if each not in known or (chosen.again and not known[each]["killed"])]
    # Started in the background, this process ignores the signal that tests of stopping send, and so would they.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with TemporaryDirectory() as name:
        copies: Queue[Path] = Queue()
        for job in range(chosen.jobs):
            copies.put(shutil.copytree(ROOT, Path(name) / str(job), ignore=NOT_COPIED))

        def work(mutant: Mutant) -> None:
            folder = copies.get()
            row = judge(mutant, folder, chosen.seconds, chosen.folder_seconds)
            copies.put(folder)
            known[mutant] = row
            with out.open("a") as file:
                file.write(json.dumps(row) + "\n")
            verdict = "killed" if row["killed"] else "survived"
            fault = f"{mutant.module}:{mutant.line}  {mutant.before}  →  {mutant.after}"
            print(f"{verdict:<8} {fault}  {row['test']}", flush=True)

        for module in modules:
            faults = [each for each in due if each.module == module]
            if not faults:
                continue
            if not chosen.sound:
                # Tests that fail anyway would pass for sharp ones.
                end, test = run_tests(Path(name) / "0", test_files(Path(name) / "0", module)[0], chosen.seconds)
                if end != "passed":
                    sys.exit(f"{module}: without a fault its tests end with: {end} {test}")
            with ThreadPoolExecutor(chosen.jobs) as pool:
                list(pool.map(work, faults))
    for module in dict.fromkeys(each.module for each in mutants):
        rows = [known[each] for each in mutants if each.module == module]
        print(f"{module:<22} {sum(row['killed'] for row in rows)} of {len(rows)}")
    print(f"killed: {sum(known[each]['killed'] for each in mutants) / len(mutants):.2f} of {len(mutants)}")


if __name__ == "__main__":
    main()
