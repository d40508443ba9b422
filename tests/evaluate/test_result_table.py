"""Tables of results: shares become percent, papers' rows are marked, and what was not measured stays empty."""

import csv
import io
import math

import numpy as np
import pytest

from gsencoder.core.files import csv_text
from gsencoder.evaluate.tables import PUBLISHED, mean_of, published_rows, table_of

TABLES = sorted(path.stem for path in PUBLISHED.glob("*.csv"))


@pytest.mark.parametrize("name", TABLES)
def test_each_published_table_has_methods_and_figures_in_percent(name: str) -> None:
    rows = published_rows(name)
    assert len(rows) >= 4
    assert all(row.source == "published" and row.method and row.values for row in rows)
    # CIDEr and minutes may be above 100; nothing is below 0, and no share is printed as a fraction.
    shares = [value for row in rows for key, value in row.values.items() if not key.startswith(("cider", "minutes"))]
    assert min(shares) >= 0
    assert 1 < max(shares) <= 100


def test_the_figures_of_the_paper_are_those_that_it_prints() -> None:
    def row(table: str, method: str) -> dict[str, float]:
        return dict(next(each.values for each in published_rows(table) if each.method == method))

    fused = "SplatDistill, fused"
    figures = {"ap_25": 28.1, "ap_50": 24.3, "ap": 19.1, "ap_head": 22.6, "ap_common": 18.6, "ap_tail": 11.1}
    assert row("splatdistill_2_instances", fused) == figures
    assert row("splatdistill_3_answers", fused)["em_refined"] == 42.1
    assert "bleu_4" not in row("splatdistill_3_answers", fused)
    assert row("splatdistill_1_recognition", "SplatDistill, distilled")["sink"] == 100.0
    assert len(published_rows("m3_2_grounding_and_retrieval")) == 9


def test_measured_shares_stand_above_published_percent() -> None:
    table = table_of(
        "Referring", {"fused": {"acc_25": 0.5, "acc_50": math.nan}}, published="splatdistill_5_referring",
        notes=["Why."],
    )  # fmt: skip
    assert table.columns == ("acc_25", "acc_50")
    first, *others = csv.DictReader(io.StringIO(csv_text(table.csv_rows())))
    assert first == {"source": "measured", "group": "", "method": "fused", "acc_25": "50", "acc_50": ""}
    assert {row["source"] for row in others} == {"published"}
    lines = table.markdown().splitlines()
    assert lines[4] == "| fused | 50.0 |  |"
    assert "| SplatDistill, distilled (published) | 43.2 | 18.2 |" in lines
    assert lines[-1] == "Why."


def test_a_bar_in_a_name_does_not_end_a_cell() -> None:
    assert "| a\\|b | 100.0 |" in table_of("Bars", {"a|b": {"x": 1.0}}).markdown()


def test_columns_are_those_of_all_measured_rows_or_those_asked_for() -> None:
    measured = {"one": {"a": 0.1}, "two": {"b": 0.2, "a": 0.3}}
    assert table_of("", measured).columns == ("a", "b")
    assert table_of("", measured, columns=("b",)).csv_rows()[0]["b"] is None


def test_classes_are_rows_of_a_second_table_beside_the_methods_that_have_them() -> None:
    measured = {"fused": {"mean": 0.5, "bed": 1.0, "lamp": 0.0}}
    table = table_of("Names", measured, published="splatdistill_1_recognition", by_class=("bed", "lamp"))
    first, second = table.markdown().split("\n**Names, by class** (percent)\n")
    assert first.splitlines()[2] == "| method | mean |"
    assert "| PointCLIP V2 (published) | 11.0 |" in first
    head, _, *rows = second.strip().splitlines()
    columns = [cell.strip() for cell in head.strip("|").split("|")]
    assert columns[:3] == ["class", "fused", "PointCLIP (published)"]
    bed, lamp = ([cell.strip() for cell in row.strip("|").split("|")] for row in rows)
    assert bed[:3] == ["bed", "100.0", "0.0"]
    # The paper has no lamp.
    assert lamp == ["lamp", "0.0", *[""] * (len(columns) - 2)]
    assert table.csv_rows()[0]["lamp"] == 0.0
    assert table.without_classes().columns == ("mean",)


def test_values_that_are_no_numbers_are_left_out() -> None:
    assert mean_of([1.0, math.nan, 4.0]) == 2.5
    assert mean_of(np.array([0.25])) == 0.25
    assert math.isnan(mean_of([]))
    assert math.isnan(mean_of(np.full(3, math.nan)))
