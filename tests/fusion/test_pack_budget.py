"""Budgets of packages: limits are kept, wider ones never cost more, and what cannot be is refused with what can."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from feature_fields import make_features, make_scene

from gsencoder.app import main as cli
from gsencoder.fusion.basis import field_error
from gsencoder.fusion.folder import load_features, save_features
from gsencoder.fusion.package import PACKAGE_FILE
from gsencoder.memory import index as index_budget
from gsencoder.types import GaussianFeatures

N = 2000
FORMS = ("compact", "index")

Pack = Callable[..., dict[str, Any]]


@pytest.fixture
def features() -> GaussianFeatures:
    return make_features(n=N)


@pytest.fixture
def folder(tmp_path: Path, features: GaussianFeatures) -> Path:
    save_features(tmp_path / "features", make_scene(N), features)
    return tmp_path / "features"


@pytest.fixture
def pack(folder: Path, tmp_path: Path) -> Pack:
    """Packs, and returns the results of the summary with the size and the error of what is read back."""
    original = load_features(folder).features["s"]

    def run(*words: str) -> dict[str, Any]:
        out = tmp_path / "out"
        assert cli.main(["pack", str(folder), f"out={out}", "overwrite=true", "quiet=true", *words]) == 0
        back = load_features(out).features["s"]
        size = (out / PACKAGE_FILE).stat().st_size / 1e6
        record = json.loads((out / "summary.json").read_text())
        error = field_error(back, original, sample=0)
        return {**record["results"], "size": size, "measured": error.total, "warnings": record["warnings"]}

    return run


@pytest.mark.parametrize("form", FORMS)
def test_a_limit_of_error_is_kept_and_a_looser_one_takes_no_more_bytes(pack: Pack, form: str) -> None:
    sizes = []
    for error in (0.003, 0.02, 0.1):
        made = pack(f"form={form}", f"budget.error={error}")
        assert made["measured"] <= error + 1e-5
        assert made["budget"]["limits"] == {"error": error}
        assert made["measured"] <= made["budget"]["measured"]["error"] + 1e-5
        assert made["warnings"] == []
        sizes.append(made["size"])
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < sizes[0]


@pytest.mark.parametrize("form", FORMS)
def test_megabytes_are_kept_and_more_of_them_are_no_less_exact(pack: Pack, form: str) -> None:
    errors, sizes = [], (0.0102, 0.014, 0.03, 1.0)
    for size in sizes:
        made = pack(f"form={form}", f"budget.megabytes={size}")
        assert made["size"] <= size
        assert made["budget"]["measured"] == {"megabytes": made["size"]}
        errors.append(made["measured"])
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < errors[0]


@pytest.mark.parametrize("form", FORMS)
def test_of_two_limits_in_conflict_the_error_is_kept_and_the_size_is_a_warning(pack: Pack, form: str) -> None:
    made = pack(f"form={form}", "budget.error=0.01", "budget.megabytes=0.009")
    assert made["measured"] <= 0.01
    conflict, broken = made["warnings"]
    assert conflict.endswith("more than budget.megabytes=0.009; budget.error comes first")
    assert broken.startswith("budget.megabytes: the limit is 0.009, and it became 0.0")
    alone = pack(f"form={form}", "budget.error=0.01")
    assert made["size"] == alone["size"]


@pytest.mark.parametrize("form", FORMS)
def test_megabytes_that_nothing_fits_into_are_refused_with_those_that_something_does(
    pack: Pack, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], form: str
) -> None:
    words = ["pack", str(folder), f"form={form}", f"out={tmp_path / 'refused'}"]
    assert cli.main([*words, "budget.megabytes=0.002"]) == 2
    message = capsys.readouterr().err
    smallest = re.search(r"takes ([\d.]+)", message)
    assert smallest
    assert len(message.strip().splitlines()) == 1
    assert not (tmp_path / "refused").exists()
    made = pack(f"form={form}", f"budget.megabytes={smallest[1]}")
    assert made["size"] == pytest.approx(float(smallest[1]), abs=1e-4)


def test_a_budget_is_refused_beside_what_it_chooses_and_where_nothing_can_be_chosen(folder, tmp_path, capsys):
    for words, message in (
        (["form=index", "index.threshold=0.8"], "index.threshold=0.8: is chosen by budget.error"),
        (["form=index", "index.threshold=0", "index.rows=9"], "index.threshold=0: is chosen by budget.error"),
        (["form=npz"], "budget.error: form=npz writes features as they are"),
        (["form=ply"], "budget.error: form=ply writes features as they are"),
    ):
        assert cli.main(["pack", str(folder), f"out={tmp_path / 'out'}", "budget.error=0.02", *words]) == 2
        assert message in capsys.readouterr().err


def test_an_error_by_its_short_name_is_the_budget(pack: Pack) -> None:
    assert pack("error=0.02")["budget"]["limits"] == {"error": 0.02}
    assert "budget" not in pack()
    assert pack()["error"] <= 0.01


def test_an_error_that_no_table_reaches_is_refused(folder, tmp_path, capsys, monkeypatch):
    indexed = index_budget._indexed
    monkeypatch.setattr(index_budget, "_indexed", lambda scene, at, most=None: indexed(scene, at, most and 300))
    out = f"out={tmp_path / 'out'}"
    assert cli.main(["pack", str(folder), "form=index", "budget.error=0.02", out]) == 2
    assert "budget.error=0.02: a table of up to 65,535 rows" in capsys.readouterr().err
    assert cli.main(["pack", str(folder), "budget.error=1e-9", out]) == 2
    assert "8 bits a coordinate reach" in capsys.readouterr().err
