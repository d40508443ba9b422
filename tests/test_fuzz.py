"""Damaged files of every kind: a valid result or an InputError of one line. `bench/fuzz.py` tries a million of them."""

import json
import signal
import warnings
from pathlib import Path
from types import ModuleType

import pytest
import test_flipped_bits

from gsencoder.core.errors import InputError
from gsencoder.data.labels.files import read_integer_lines
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
        # Archives with their checksums have a test of their own: test_flipped_bits.py.
        kinds = [kind for kind in KINDS if kind not in test_flipped_bits.KINDS and not kind.startswith(LEFT_OUT)]
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


# What fuzzing broke


def test_a_mask_with_an_endless_name_is_refused_in_a_short_line(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(f"{'masks' * 1000} 4 0.5\n")
    with pytest.raises(InputError, match="line 1: expected a mask file, got a name of 5,000 characters"):
        read_instance_prediction(tmp_path / "a.txt", num_vertices=4)


def test_a_number_of_thousands_of_digits_is_refused_and_one_of_zeros_is_none(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("1\n" + "4" * 5000 + "\n")
    with pytest.raises(InputError, match="line 2: expected one whole number, got '4{40}'$"):
        read_integer_lines(tmp_path / "a.txt")
    (tmp_path / "a.txt").write_text("0" * 5000 + "7\n")
    assert read_integer_lines(tmp_path / "a.txt").tolist() == [7]


@pytest.mark.parametrize("name", ["q" * 5000, "que\nry"])
def test_an_unknown_field_of_a_question_is_named_on_one_short_line(tmp_path: Path, name: str) -> None:
    (tmp_path / "q.jsonl").write_text(json.dumps({"question": "What?", name: "x"}) + "\n")
    with pytest.raises(InputError, match="line 1: 'qu?e?.*': no such field") as refused:
        read_questions(tmp_path / "q.jsonl")
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 300
