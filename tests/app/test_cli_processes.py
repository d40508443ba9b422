"""The program in a process of its own: exit codes, streams, signals, how fast help comes; and as one of several."""

import os
import pickle
import resource
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from command_runs import refusal
from toy_commands import splat

from gsencoder.app import main as cli
from gsencoder.app.main import COMMANDS
from gsencoder.data.synthetic import make_room, write_room


def test_a_launcher_in_another_process_can_take_a_run(tmp_path: Path) -> None:
    from gsencoder.app.compose import _job

    run = partial(cli._run_one, COMMANDS["inspect"], debug=False)
    job = pickle.dumps(partial(_job, cls=COMMANDS["inspect"].load()[0], run=run, swept=()))
    (tmp_path / "job").write_bytes(job)
    code = (
        "import pickle, sys; job = pickle.load(open(sys.argv[1], 'rb'));"
        "from omegaconf import OmegaConf; print(OmegaConf.create({'a': '${text:x41}'}).a, job.keywords['cls'].__name__)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "job")], capture_output=True, text=True)
    assert done.stdout == "A InspectConfig\n", done.stderr


def run_process(*words: str, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "gsencoder", *words], capture_output=True, text=True, **options)


HEAVY = ("torch", "numba", "open3d", "numpy", "hydra", "scipy", "sklearn", "rich")


def test_help_comes_at_once_and_imports_nothing_heavy() -> None:
    code = (
        "import sys; from gsencoder.app.main import main; main(['--help']);"
        f"print('LOADED', *[name for name in {HEAVY} if name in sys.modules])"
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.stdout.splitlines()[-1] == "LOADED"
    # Seconds of the processor, which other processes do not change much.
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 0.5


def test_file_names_that_are_not_utf8_are_told(tmp_path: Path) -> None:
    name = os.fsdecode(b"caf\xe9.ply")
    (tmp_path / name).write_bytes(splat(tmp_path / "a.ply").read_bytes())
    done = run_process("inspect", name, "out=out", cwd=tmp_path, env={**os.environ, "PYTHONIOENCODING": "utf-8:strict"})
    assert (done.returncode, done.stderr) == (0, "")
    assert "caf\\udce9.ply" in done.stdout


@pytest.mark.skipif(os.name != "posix", reason="pipes")
def test_a_reader_that_leaves_early_is_not_an_error(tmp_path: Path) -> None:
    path = splat(tmp_path / "a.ply")
    read, write = os.pipe()
    os.close(read)
    with subprocess.Popen(
        [sys.executable, "-m", "gsencoder", "inspect", str(path), f"out={tmp_path / 'out'}"],
        stdout=write,
        stderr=subprocess.PIPE,
    ) as process:
        os.close(write)
        assert process.communicate()[1] == b""
        assert process.returncode == 1
    assert (tmp_path / "out" / "summary.json").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="/dev/full")
def test_a_full_standard_output_is_one_line(tmp_path: Path) -> None:
    path = splat(tmp_path / "a.ply")
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "gsencoder", "inspect", str(path)], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert (done.returncode, done.stderr) == (2, "error: standard output: no space left on the device\n")


SLOW = """
import sys, time
from gsencoder.app import main as cli
from gsencoder.app.commands import inspect
from gsencoder.app.output import output_folder
def run(config, summary):
    with output_folder(config.out) as folder:
        (folder / "half").write_text("x")
        print("writing", flush=True)
        time.sleep(60)
inspect.run = run
sys.exit(cli.main())
"""


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize(
    ("number", "code", "problem"),
    [(signal.SIGINT, 130, b"interrupted\n"), (signal.SIGTERM, 143, b"stopped: SIGTERM\n")],
)
def test_signals_leave_no_half_written_output(tmp_path: Path, number: int, code: int, problem: bytes) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", SLOW, "inspect", "a", f"out={tmp_path / 'out'}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        assert process.stdout.readline() == b"writing\n"
        process.send_signal(number)
        assert process.communicate()[1] == problem
        assert process.returncode == code
    assert list(tmp_path.iterdir()) == []


GIVEN = {"ask": ["features", "question=where"], "score": ["answers", "predictions=a.json", "truth=b.json"], "demo": []}
"""What a command needs to come as far as its start."""


@pytest.fixture
def second_of_three(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"RANK": "1", "WORLD_SIZE": "3", "LOCAL_RANK": "1"}.items():
        monkeypatch.setenv(name, value)


@pytest.mark.parametrize("name", [each.name for each in COMMANDS.values() if not each.several])
def test_a_command_without_work_to_share_says_so(name, second_of_three, tmp_path, capsys):
    out = tmp_path / ("out.html" if name == "view" else "out")
    line = refusal(capsys, name, *GIVEN.get(name, ["scene"]), f"out={out}")
    assert line.startswith(f"error: {name}: runs in one process, and this is process 1 of 3")
    assert not out.exists()


def test_one_scene_is_not_for_several_processes(second_of_three, tmp_path, capsys):
    write_room(make_room(0, objects=1, views=2, width=40, height=30), tmp_path / "room")
    line = refusal(capsys, "fuse", str(tmp_path / "room"), "teacher=palette", f"out={tmp_path / 'out'}")
    assert "room: runs in one process, and this is process 1 of 3" in line
    assert "give several scenes, which processes share" in line
    assert not (tmp_path / "out").exists()
