"""The figures that `make bench` remakes: what the registry names is there, and the runner loses nothing on the way."""

import json
import re
import runpy
import shlex
import sys
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

import pytest
from test_docs import anchor_of, complaint, text_of

ROOT = Path(__file__).parents[1]
BENCH = ROOT / "bench"
SAMPLES = Path(__file__).with_name("bench_outputs.json")
"""What commands of some entries wrote, a small part of it, and the figures that were read from it."""


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What bench/run.py defines."""
    monkeypatch.syspath_prepend(str(BENCH))
    return runpy.run_path(str(BENCH / "run.py"))


@pytest.fixture
def entries(script: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(script["load_registry"]())


def test_no_script_of_bench_hides_a_module_of_python_or_of_a_package() -> None:
    """Python looks for imports beside the script first."""
    names = {path.stem for path in BENCH.glob("*.py")}
    assert not names & set(sys.stdlib_module_names)
    path = [folder for folder in sys.path if folder != str(BENCH)]
    specs = {name: PathFinder.find_spec(name, path) for name in names}
    assert [name for name, spec in specs.items() if spec is not None and spec.origin is not None] == []


def command_lines(command: str) -> list[str]:
    """The lines of a command, with NAME for the variables of loops."""
    return [re.sub(r"\$[a-z]\w*", "NAME", line.strip()) for line in re.split(r"\n|; ", command) if line.strip()]


def options_of(source: str) -> set[str]:
    options = set(re.findall(r'add_argument\(\s*"(--[\w-]+)"', source))
    return options | ({"--json"} if "add_json_option(" in source else set())


def test_commands_name_scripts_and_options_that_are_there(entries: tuple[Any, ...]) -> None:
    wrong, scripts = [], set()
    for entry in entries:
        for line in command_lines(entry.command):
            if match := re.match(r"(?:do )?gsencoder (.*)", line):
                wrong += filter(None, [complaint(match[1], set())])
            elif match := re.match(r"python (bench/\w+\.py)", line):
                source = (ROOT / match[1]).read_text(encoding="utf-8")
                words = shlex.split(line)
                wrong += [f"{line}: {word}" for word in words if word[:2] == "--" and word not in options_of(source)]
                scripts.add(match[1])
            else:
                assert re.match(r"(for|do|done)\b", line), line
    assert wrong == []
    assert len(scripts) >= 25


def measurements() -> str:
    """The summary and the pages of results below each other."""
    pages = [ROOT / "docs" / "measurements.md", *sorted((ROOT / "docs" / "results").glob("*.md"))]
    return "\n".join(text_of(page) for page in pages if page.stem != "decisions")


def test_sections_are_headings_of_the_measurements(entries: tuple[Any, ...]) -> None:
    page = measurements()
    headings = {anchor_of(heading) for heading in re.findall(r"^#+ (.*)$", page, re.MULTILINE)} | {"readmemd"}
    assert [each.section for each in entries if anchor_of(each.section) not in headings] == []


def test_what_is_recorded_stands_in_the_section(entries: tuple[Any, ...]) -> None:
    readme, page = (text.replace(",", "") for text in (text_of(ROOT / "README.md"), measurements()))
    missing = []
    for entry in entries:
        text = readme
        if entry.section != "README.md":
            marks, rest = re.split(rf"^(##+) {re.escape(entry.section)}\n", page, maxsplit=1, flags=re.M)[1:]
            text = re.split(rf"^#{{2,{len(marks)}}} ", rest, flags=re.M)[0]
        for figure in entry.figures:
            forms = [figure.stated] if figure.stated else [f"{figure.recorded:.{digits}f}" for digits in range(6)]
            same = [form for form in forms if figure.stated or abs(float(form) - figure.recorded) < 1e-12]
            # Ratios are stated as ranges, in the middle of which they are recorded.
            if figure.kind in ("accuracy", "error", "count", "bytes") and not any(
                re.search(rf"(?<![\d.]){re.escape(form)}(?!\d)", text) for form in same
            ):
                missing.append(f"{entry.name}: {figure.name}: {same}")
    assert missing == []


def test_figures_are_read_from_what_commands_wrote(entries: tuple[Any, ...], tmp_path: Path) -> None:
    samples = json.loads(SAMPLES.read_text(encoding="utf-8"))
    by_name = {entry.name: entry for entry in entries}
    for name, sample in samples.items():
        for file, content in sample["files"].items():
            path = tmp_path / name / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(content), encoding="utf-8")
        read = {each.name: each.read(tmp_path / name, sample["printed"]) for each in by_name[name].figures}
        assert read == sample["figures"]
    # The readers of all scripts but those that take minutes on a small scene.
    assert len(samples) >= 15


# The run on a GPU (`make gpu`), smaller and on a CPU: every part works, and a failure of one hides no other

LEFT_OUT = ("processes", "onnx")
"""Parts that take long here, and whose work tests of training and of exports do."""


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What bench/gpu.py defines."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    return runpy.run_path(str(BENCH / "gpu.py"))


def run_gpu(gpu: dict[str, Any], monkeypatch: pytest.MonkeyPatch, out: Path, *words: str) -> tuple[int, list[Any]]:
    """The exit code and the parts of the report."""
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--small", "--device", "cpu", "--out", str(out), *words])
    code = gpu["main"]()
    return code, json.loads(out.with_suffix(".json").read_text())


@pytest.mark.slow
def test_every_part_is_well_on_a_cpu_or_says_why_it_is_skipped(gpu, tmp_path, monkeypatch):
    names = [name for name in gpu["PARTS"] if name not in LEFT_OUT]
    code, parts = run_gpu(gpu, monkeypatch, tmp_path / "gpu.md", "--parts", ",".join(names))
    states = {each["part"]: each["state"] for each in parts}
    assert list(states) == names
    allowed = re.compile(r"ok|skipped: (no CUDA device|package missing: .+)")
    assert [f"{name}: {state}" for name, state in states.items() if not allowed.fullmatch(state)] == []
    assert states["blend"] == states["losses"] == "ok"
    assert code == 0
    report = (tmp_path / "gpu.md").read_text()
    assert all(f"| {name} |" in report for name in states)


def test_a_part_that_raises_is_reported_and_hides_no_other(gpu, tmp_path, monkeypatch):
    def broken(setting: Any) -> list[Any]:
        raise ValueError("a kernel | was lost\nin two lines")

    chosen = {"environment": gpu["environment"], "broken": broken, "products": gpu["PARTS"]["products"]}
    gpu["PARTS"].clear()
    gpu["PARTS"].update(chosen)
    code, parts = run_gpu(gpu, monkeypatch, tmp_path / "gpu.md", "--parts", "environment,broken,products")
    assert code == 1
    assert [each["state"].split(" (")[0] for each in parts] == ["ok", "failed: ValueError: a kernel | was lost", "ok"]
    assert "| broken | failed: ValueError: a kernel \\| was lost" in (tmp_path / "gpu.md").read_text()
