"""Many runs of one command line: sweeps, failures among them, launchers."""

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest

from gsencoder.app import main as cli


def test_many_runs_sweep_numbers_and_keep_text(toy, tmp_path, capsys, monkeypatch):
    out = tmp_path / "o=${t},'s"
    words = ["toy", "-m", "a,b=", "size=1,2", "word=mug,banana", f"out={out}"]
    (tmp_path / "a,b=").touch()
    monkeypatch.chdir(tmp_path)
    assert cli.main(words) == 0
    assert sorted(os.listdir()) == sorted(["a,b=", out.name])
    assert sorted(os.listdir(out)) == ["0", "1", "multirun.yaml"]
    records = [json.loads((out / str(k) / "summary.json").read_text()) for k in range(2)]
    assert [record["results"]["size"] for record in records] == [1, 2]
    assert {(out / str(k) / "word").read_text() for k in range(2)} == {"mug,banana"}
    assert records[1]["settings"]["paths"] == ["a,b="]
    assert capsys.readouterr().err == "run 0: size=1\nrun 1: size=2\n"


def test_text_is_swept_where_it_is_asked_for(toy: Any, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert cli.main(["toy", "-m", "word=choice(mug,'red, cup')", f"out={out}", "quiet=true"]) == 0
    assert [(out / str(k) / "word").read_text() for k in range(2)] == ["mug", "red, cup"]


def test_a_failed_run_does_not_stop_the_others(toy: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert cli.main(["toy", "-m", "size=-1,x,3", f"out={out}", "quiet=true"]) == 2
    assert sorted(os.listdir(out)) == ["2", "multirun.yaml"]
    assert capsys.readouterr().err.splitlines() == [
        f"error: {out / '0'}: size: expected a positive number",
        "error: run 1: size: expected a whole number, got 'x' (how large)",
        "error: 2 of 3 runs failed",
    ]


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["toy", "-m", "size=1,2"], "-m: out= is missing"),
        (["toy", "-m", "size=1,2", "out=choice(a,b)"], "out: cannot be swept"),
        (["toy", "-m", "--cfg", "out=x"], "--cfg: shows one run"),
        (["repair", "-m", "a.ply", "out=x.ply"], "-m: repair writes a file"),
    ],
)
def test_many_runs_complain_like_one(toy, words, problem, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(words) == 2
    err = capsys.readouterr().err
    assert problem in err
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["hydra/launcher=nowhere"], "no such launcher is installed; .*pip install 'gsencoder\\[slurm\\]'"),
        (
            ["hydra/launcher=submitit_slurm", "+hydra.launcher.additional_parameters.account=mine"],
            "submitit_slurm: .*srun.*the logs of the jobs are in .*submitit",
        ),
    ],
)
def test_a_launcher_that_cannot_start_jobs_says_so_in_one_line(toy, words, problem, tmp_path, monkeypatch, capsys):
    if "submitit" in words[0]:
        pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    monkeypatch.setenv("PATH", "")
    assert cli.main(["toy", "-m", "size=1,2", f"out={tmp_path / 'out'}", *words]) == 2
    err = capsys.readouterr().err
    assert re.search(problem, err)
    assert err.count("\n") == 1
