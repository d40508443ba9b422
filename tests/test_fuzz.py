"""Damaged files of every kind: a valid result or an InputError of one line. `bench/fuzz.py` tries a million of them."""

import json
import random
import signal
import sys
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import splat_samples
import test_flipped_bits

from gsencoder.core.errors import InputError
from gsencoder.data.labels.files import read_whole_numbers
from gsencoder.data.splats.files import RawSplat
from gsencoder.data.splats.repair import inspect_splat
from gsencoder.evaluate.benchmarks.instances import read_instance_prediction
from gsencoder.infer.ask.questions import read_questions

BENCH = Path(__file__).parents[1] / "bench"
LEFT_OUT = ("prepared scene", "space of prepared", "counts of prepared", "encoder", "training")
"""Kinds whose files take seconds to make: bench alone reads them."""
CASES = 5


@pytest.fixture
def fuzz(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCH))
    import fuzz

    return fuzz


@pytest.mark.slow
@pytest.mark.usefixtures("no_jaxtyping")
def test_no_damaged_file_of_any_kind_crashes_its_reader(fuzz: ModuleType, tmp_path: Path) -> None:
    from fuzz_samples import KINDS

    before = signal.signal(signal.SIGALRM, fuzz._late)
    ended: dict[str, int] = {"read": 0, "refused": 0, "crash": 0}
    try:
        # Splats and archives with their checksums have tests of their own: test_splat_fuzz.py, test_flipped_bits.py.
        elsewhere = {*splat_samples.valid_files(tmp_path), *test_flipped_bits.KINDS}
        kinds = [kind for kind in KINDS if kind not in elsewhere and not kind.startswith(LEFT_OUT)]
        for number, kind in enumerate(kinds):
            (tmp_path / str(number)).mkdir()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                reader = fuzz.Reader(kind, tmp_path / str(number))
                for case in range(CASES):
                    end, why = reader.case(case, 1)
                    ended[end] += 1
                    assert end != "crash", (kind, case, why)
                reader.close()
                reader.sample.read()
    finally:
        signal.signal(signal.SIGALRM, before)
    assert ended["read"] > 15
    assert ended["refused"] > 80


def test_a_case_follows_from_its_seed_and_changes_the_file(fuzz: ModuleType) -> None:
    for name, data in (
        ("a.json", b'{"a": [1, 2.5, "x"], "b": {"c": null}}'),
        ("a.txt", b"1 2 3\n"),
        ("a.ply", b"ply\n" * 9),
    ):
        forms = [fuzz.changed(data, name, random.Random(seed)) for seed in range(200)]
        assert forms == [fuzz.changed(data, name, random.Random(seed)) for seed in range(200)]
        assert len(set(forms)) > 60
        assert sum(form != data for form in forms) > 150


def test_crashes_slowness_and_long_messages_are_told_from_refusals(fuzz: ModuleType, tmp_path: Path) -> None:
    from fuzz_samples import Sample

    def ending(read: Any) -> str:
        reader = fuzz.Reader.__new__(fuzz.Reader)
        (tmp_path / "a.txt").write_bytes(b"1 2")
        reader.kind, reader.sample, reader.sound = "x", Sample((tmp_path / "a.txt",), read), [b"1 2"]
        end, why = reader.case(0, 0)
        assert (tmp_path / "a.txt").read_bytes() == b"1 2"
        assert bool(why) == (end == "crash")
        return str(end)

    def refuse(message: str) -> None:
        raise InputError(message)

    def fail(error: BaseException) -> None:
        raise error

    assert ending(lambda: None) == "read"
    assert ending(lambda: refuse("a.txt: no")) == "refused"
    assert ending(lambda: refuse("a\nb")) == "crash"
    for error in (KeyError("a"), MemoryError(), RecursionError(), fuzz.Slow(), SystemExit(1)):
        assert ending(lambda error=error: fail(error)) == "crash"


def test_a_run_that_was_stopped_goes_on_from_its_blocks(
    fuzz: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [
        {"kind": "split", "start": start, "seed": 0, "read": 250, "refused": 0, "crash": 0, "seconds": 1.0}
        for start in (0, 250)
    ]
    (tmp_path / "blocks.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    monkeypatch.setattr(fuzz, "Worker", lambda seed: pytest.fail("nothing is left to do"))
    assert fuzz.run(tmp_path, ["split"], 500, 0, 0) == 0
    assert "500 cases of 1 kinds: 500 read, 0 refused, 0 crashes" in capsys.readouterr().out
    assert sys.exc_info() == (None, None, None)


# What fuzzing broke


def test_a_splat_of_infinite_scales_has_no_median_scale() -> None:
    raw = RawSplat(
        means=np.zeros((3, 3)),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (3, 1)),
        log_scales=np.full((3, 3), 1e30, np.float32),
        logit_opacities=np.zeros(3, np.float32),
        sh=np.zeros((3, 1, 3), np.float32),
        format="test",
    )
    with np.errstate(over="ignore"):
        report = inspect_splat(raw)
    assert report.median_scale is None
    json.dumps(report.to_dict(), allow_nan=False)


def test_a_mask_with_an_endless_name_is_refused_in_a_short_line(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(f"{'masks' * 1000} 4 0.5\n")
    with pytest.raises(InputError, match="line 1: expected a mask file, got a name of 5,000 characters"):
        read_instance_prediction(tmp_path / "a.txt", num_vertices=4)


def test_a_number_of_thousands_of_digits_is_refused_and_one_of_zeros_is_none(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("1\n" + "4" * 5000 + "\n")
    with pytest.raises(InputError, match="line 2: expected one whole number, got '4{40}'$"):
        read_whole_numbers(tmp_path / "a.txt")
    (tmp_path / "a.txt").write_text("0" * 5000 + "7\n")
    assert read_whole_numbers(tmp_path / "a.txt").tolist() == [7]


def test_a_mask_with_a_null_in_its_name_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(b"masks\0/a.txt 4 0.5\n")
    with pytest.raises(InputError, match="line 1: the mask .* cannot be read"):
        read_instance_prediction(tmp_path / "a.txt", num_vertices=4)


@pytest.mark.parametrize("name", ["q" * 5000, "que\nry"])
def test_an_unknown_field_of_a_question_is_named_on_one_short_line(tmp_path: Path, name: str) -> None:
    (tmp_path / "q.jsonl").write_text(json.dumps({"question": "What?", name: "x"}) + "\n")
    with pytest.raises(InputError, match="line 1: 'qu?e?.*': no such field") as refused:
        read_questions(tmp_path / "q.jsonl")
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 300
