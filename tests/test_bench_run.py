"""The figures that `make bench` remakes: what the registry names is there, and the runner loses nothing on the way."""

import json
import os
import re
import runpy
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
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
    return "\n".join(
        text_of(page)
        for page in (ROOT / "docs" / "measurements.md", *sorted((ROOT / "docs" / "results").glob("*.md")))
        if page.stem != "decisions"
    )


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


@pytest.mark.parametrize(
    ("where", "content", "message"),
    [
        ({"at": "a > b"}, '{"a": {"c": 1}}', "no 'b' of 'a > b' in figures.json; there is c"),
        ({"at": "a"}, "{", "cannot be read"),
        ({"pattern": r"(\d+) of"}, "{}", "matches 0 times, expected once"),
    ],
)
def test_a_figure_that_is_not_there_is_named(entries, tmp_path, where, content, message):
    (tmp_path / "figures.json").write_text(content)
    figure = replace(entries[0].figures[0], **({"at": "", "pattern": ""} | where), file="figures.json")
    with pytest.raises(Exception, match=re.escape(message)) as raised:
        figure.read(tmp_path, "nothing")
    assert type(raised.value).__name__ == "RegistryError"


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """A small registry and a folder of results."""

    registry: Path
    out: Path
    script: dict[str, Any]
    monkeypatch: pytest.MonkeyPatch

    def run(self, *words: str) -> tuple[int, dict[tuple[str, str], str]]:
        """The exit code, and the state of each figure."""
        words = ("--registry", str(self.registry), "--out", str(self.out), *words)
        self.monkeypatch.setattr(sys, "argv", ["run.py", *words])
        before = signal.getsignal(signal.SIGTERM)
        try:
            code = self.script["main"]()
        finally:
            signal.signal(signal.SIGTERM, before)
        rows = json.loads((self.out / "results.json").read_text())["figures"]
        return code, {(row["entry"], row["figure"]): row["state"] for row in rows}


@pytest.fixture
def bench(script: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    registry = tmp_path / "figures.yaml"
    registry.write_text(
        """
entries:
- name: good
  section: Blend
  minutes: 1
  command: echo '{"same":2.0004,"moved":5,"digits":0.74461}' > $OUT/figures.json
  figures:
  - {name: "evenly spread: recorded: mean", at: digits, kind: accuracy, recorded: 0.740, spread: 0.0005}
  - {name: same, at: same, kind: accuracy, recorded: 2, spread: 0.0005}
  - {name: moved, at: moved, kind: count, recorded: 4, spread: 0}
  - {name: seconds, at: moved, kind: seconds, recorded: 1, spread: 0}
- name: spread
  section: Blend
  minutes: 1
  repeats: 2
  command: echo x >> COUNT; echo "{\\"ratio\\":$(wc -l < COUNT)}" > $OUT/figures.json
  figures:
  - {name: ratio, at: ratio, kind: ratio, recorded: 1, spread: 0.1}
- name: failing
  section: Blend
  minutes: 1
  command: test -e MENDED || (echo sorry; exit 3); echo '{"a":1}' > $OUT/figures.json
  figures:
  - {name: a, at: a, kind: count, recorded: 1, spread: 0}
- name: hanging
  section: Blend
  minutes: 0.001
  command: sleep 60 & wait
  figures:
  - {name: a, at: a, kind: count, recorded: 1, spread: 0}
- name: elsewhere
  section: Blend
  minutes: 1
  needs: [shared]
  command: exit 1
  figures:
  - {name: a, at: a, kind: count, recorded: 1, spread: 0}
""".replace("COUNT", str(tmp_path / "count")).replace("MENDED", str(tmp_path / "mended"))
    )
    monkeypatch.setenv("GSENCODER_SHARED", str(tmp_path / "nothing"))
    return Bench(registry=registry, out=tmp_path / "out", script=script, monkeypatch=monkeypatch)


def test_failing_and_hanging_entries_hide_no_other_and_a_later_call_goes_on(bench: Bench) -> None:
    code, states = bench.run()
    assert code == 1
    assert states["good", "same"] == "as recorded"
    assert states["good", "moved"] == "moved"
    assert states["good", "seconds"] == "not judged"
    # One of the two runs is what is recorded.
    assert states["spread", "ratio"] == "as recorded"
    assert re.match(r"failed with exit code 3: sorry \(", states["failing", "a"])
    assert states["hanging", "a"].startswith("stopped after")
    assert states["elsewhere", "a"].startswith("skipped: needs shared")
    report = (bench.out / "results.md").read_text()
    assert "| good | moved (count) | 4 ± 0 | 5 ± 0 (1) | **moved** |" in report

    # What was being written when the machine went down.
    with (bench.out / "runs.jsonl").open("a") as file:
        file.write('{"entry": "failing", "rou')
    (bench.registry.parent / "mended").touch()
    _, states = bench.run("--only", "failing")
    assert states["failing", "a"] == "as recorded"
    assert states["good", "moved"] == "moved"
    runs = [json.loads(line)["entry"] for line in (bench.out / "runs.jsonl").read_text().splitlines()[1:]]
    assert sorted(runs) == ["failing", "failing", "good", "hanging", "spread", "spread"]


def test_a_runner_that_is_ended_takes_its_command_with_it(bench: Bench, tmp_path: Path) -> None:
    pid = tmp_path / "pid"
    text = bench.registry.read_text()
    bench.registry.write_text(
        text.replace(
            "minutes: 0.001\n  command: sleep 60 & wait",
            f"minutes: 1\n  command: sleep 0.5; echo $$ > {pid}; sleep 60 & wait",
        )
    )
    command = [sys.executable, BENCH / "run.py", "--registry", bench.registry, "--out", bench.out, "--only", "hanging"]
    with subprocess.Popen([str(word) for word in command], stdout=subprocess.DEVNULL) as process:
        while not (pid.exists() and pid.read_text()):
            assert process.poll() is None
            time.sleep(0.05)
        process.terminate()
        assert process.wait() == 128 + signal.SIGTERM
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)


def test_minutes_take_deterministic_entries_first(script: dict[str, Any], entries: tuple[Any, ...]) -> None:
    chosen = script["choose"](entries, [], 60)
    assert 20 < sum(entry.minutes * entry.repeats for entry in chosen) <= 60
    ratios = [any(figure.kind == "ratio" for figure in entry.figures) for entry in chosen]
    assert ratios == sorted(ratios)
    with pytest.raises(script["RegistryError"], match="--only 'nothing': no such entry; there are demo"):
        script["choose"](entries, ["nothing"], 0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("name: spread", "name: good", "stands twice: good"),
        ("recorded: 4, spread: 0", "recorded: 4, spread: -1", "a spread from 0"),
        ("at: same", "at: same, pattern: x", "expected at or pattern"),
        ("minutes: 0.001", "minutes: 0.001\n  hours: 2", "hours"),
    ],
)
def test_a_wrong_registry_is_refused(bench, capsys, old, new, message):
    text = bench.registry.read_text()
    assert old in text
    bench.registry.write_text(text.replace(old, new, 1))
    with pytest.raises(SystemExit):
        bench.run()
    assert message in capsys.readouterr().err
    assert not bench.out.exists()
