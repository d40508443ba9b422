"""The figures of pages of results are those of the results."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from selected_rooms import SPACE, selected_room, words

from gsencoder.app import main as cli
from gsencoder.app import reports as parts
from gsencoder.app.commands import demo
from gsencoder.app.commands.localize import add_words
from gsencoder.app.options import CommonConfig
from gsencoder.app.run import Run
from gsencoder.core.errors import InputError
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.fusion.fuse import FuseConfig, Fusion
from gsencoder.infer.localize import localize
from gsencoder.infer.page.page import Bundle
from gsencoder.infer.page.report import HtmlReport
from gsencoder.teachers.labels import PaletteTeacher
from gsencoder.text.table import make_text_table, save_text_table
from gsencoder.types import FeatureBasis, Localization, Scene

SCENE, KINDS = selected_room()


class Page(HtmlReport):
    """Records what is added to a page."""

    made: ClassVar["list[Page]"] = []

    def __init__(self, title: str = "", lead: str = "") -> None:
        super().__init__(title, lead)
        self.told: dict[str, Any] = {}
        self.tables: list[list[dict[str, Any]]] = []
        self.shown: list[tuple[list[np.ndarray], list[str]]] = []
        self.headings: list[str] = []
        Page.made.append(self)

    def facts(self, facts: Any) -> None:
        self.told |= facts

    def section(self, heading: str, text: str = "") -> None:
        self.headings.append(heading)

    def pictures(self, pictures: Any, captions: Any, **options: Any) -> None:
        assert len(pictures) == len(captions)
        self.shown.append((list(pictures), list(captions)))

    def table(self, columns: Any, rows: Any) -> None:
        self.tables.append([dict(zip(columns, row, strict=True)) for row in rows])

    def timings(self, seconds: Any) -> None:
        self.told["steps"] = dict(seconds)

    def write(self, path: Any) -> None:
        self.path = path


@pytest.fixture
def page(monkeypatch: pytest.MonkeyPatch) -> Page:
    monkeypatch.setattr(parts, "HtmlReport", Page)
    return Page()


def last() -> Page:
    return Page.made[-1]


def summary_of(**arguments: Any) -> Run:
    summary = Run("test", CommonConfig())
    summary.results.update(arguments)
    summary.add_seconds({"load": 1.5, "work": 2.0})
    return summary


def found() -> Localization:
    """Two boxes of the mug (the book has its feature, paler), one of the table, and none of the lamp."""
    features = SCENE.features["names"]
    vectors = features.features.copy()
    vectors[KINDS == 1] = 0.8 * vectors[KINDS == 0][0] + 0.2 * vectors[KINDS == 2][-1]
    scene = replace(SCENE, features={"names": replace(features, features=vectors)})
    made = localize(scene, ("mug", "table", "lamp"), words())
    counts = [sum(box.query == word for box in made.boxes) for word in made.queries]
    assert counts == [2, 1, 0]
    return made


@pytest.mark.filterwarnings("ignore:.*words have no box")
def test_words_have_a_row_each_of_their_best_box(page: Page) -> None:
    made = found()
    add_words(page, SCENE, made)
    (rows,) = page.tables
    assert [row["word"] for row in rows] == ["mug", "table", "lamp"]
    assert [row["boxes"] for row in rows] == [2, 1, 0]
    assert [row["probability"] for row in rows] == made.probabilities.tolist()
    best = next(box for box in made.boxes if box.query == "mug")
    assert rows[0]["score"] == best.score
    assert rows[0]["center of the first"] == ", ".join(f"{value:.2f}" for value in best.center)
    assert (rows[2]["score"], rows[2]["center of the first"]) == (0.0, "–")
    assert page.shown[0][1] == ["mug: 2 boxes", "table: 1 box", "lamp: no box"]
    ious = {"mug": 0.9, "table": 0.25, "lamp": 0.0}
    add_words(page, SCENE, made, ious)
    assert [row["IoU with the truth"] for row in page.tables[1]] == [0.9, 0.25, 0.0]
    assert page.shown[2][1] == ["mug: IoU 0.90 with the true box", "table: IoU 0.25 with the true box", "lamp: no box"]


def pictured() -> Scene:
    """The scene with photographs of one color each: the number of their view."""
    views = SCENE.views
    assert views is not None
    images = [np.full((72, 96, 3), view, np.uint8) for view in range(len(views))]
    return replace(SCENE, views=replace(views, images=images))


def test_four_views_from_first_to_last_are_shown_with_their_numbers(page: Page) -> None:
    scene = pictured()
    parts.add_views(page, scene, {"names": scene.features["names"]})
    photographs, rendered, depths, fields = page.shown
    views = [0, 2, 5, 7]
    assert photographs[1] == [f"view {view}" for view in views]
    assert [int(picture[0, 0, 0]) for picture in photographs[0]] == views
    assert rendered[1][1] == "view 2, rendered"
    assert depths[1][2] == "view 5, depth, bright is near"
    assert fields[1][3] == "view 7, names"


def test_features_have_the_figures_of_their_basis_or_none(page: Page) -> None:
    features = SCENE.features["names"]
    weights = features.weights.copy()
    weights[:7] = 0
    bare = replace(features, weights=weights)
    basis = FeatureBasis(
        mean=np.zeros(8, np.float32), components=np.eye(3, 8, dtype=np.float32), energy_kept=0.75, space=SPACE
    )
    small = replace(features, features=features.features[:, :3].copy(), basis=basis)
    parts.add_features(page, {"bare": bare, "small": small}, {"bare": 0.0, "small": 0.125})
    assert page.tables[0] == [
        {"features": "bare", "channels": 8, "rank of the basis": 8, "energy kept": 1.0, "centered cosine error": 0.0,
         "Gaussians seen": len(KINDS) - 7},
        {"features": "small", "channels": 8, "rank of the basis": 3, "energy kept": 0.75,
         "centered cosine error": 0.125, "Gaussians seen": len(KINDS)},
    ]  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*words have no box")
def test_the_page_of_the_demo_counts_words_and_what_the_basis_costs(monkeypatch, tmp_path):
    monkeypatch.setattr(demo, "HtmlReport", Page)
    features = SCENE.features["names"]
    fusion = Fusion(features=features, views=(0,), depth_sources=(), config=FuseConfig(), teacher=PaletteTeacher())
    made = demo.TeacherResult(
        title="names", words=("mug", "table", "lamp"), ious=(0.9, 0.4, 0.0), fusion=fusion, localization=found()
    )
    demo.write_report(tmp_path / "a.html", SCENE, [made], summary_of(views=8))
    facts = last().told
    assert (facts["names localized"], facts["Gaussians"], facts["views"]) == ("1 of 3", len(KINDS), 8)
    assert facts["seconds before this page"] == 3.5
    assert [row["IoU with the truth"] for row in last().tables[0]] == [0.9, 0.4, 0.0]
    assert last().tables[1][0]["centered cosine error"] == 0.0


@pytest.mark.filterwarnings("ignore:.*words have no box")
def test_a_teacher_counts_what_overlaps_by_half_or_more() -> None:
    features = SCENE.features["names"]
    fusion = Fusion(features=features, views=(0,), depth_sources=(), config=FuseConfig(), teacher=PaletteTeacher())
    made = demo.TeacherResult(
        title="names", words=("a", "b", "c"), ious=(0.5, 0.49, 1.0), fusion=fusion, localization=found()
    )
    assert made.num_localized == 2
    assert made.to_dict() == {
        "rank": 8, "channels": 8, "seen": len(KINDS), "mean_iou": pytest.approx(1.99 / 3),
        "iou": {"a": 0.5, "b": 0.49, "c": 1.0},
    }  # fmt: skip


UNSAFE = "<script>alert(1)<"


@pytest.mark.slow
def test_fusion_words_and_scores_have_pages_in_which_names_are_text(tmp_path: Path) -> None:
    made = make_room(4, views=4, width=120, height=90)
    write_room(made, tmp_path / UNSAFE)
    names = sorted({each.name for each in made.objects if each.name})
    save_text_table(tmp_path / "words", make_text_table(names, np.eye(len(names), dtype=np.float32), "room"))
    common = ["report=true", "quiet=true"]
    scene, teacher = str(tmp_path / UNSAFE), f"teacher.words={tmp_path / 'words'}"
    assert cli.main(["fuse", scene, teacher, f"out={tmp_path / 'f'}", *common]) == 0
    words = ",".join(names[:2])
    assert cli.main(["localize", str(tmp_path / "f"), f"query={words}", f"out={tmp_path / 'l'}", *common]) == 0
    assert cli.main(["evaluate", scene, teacher, "protocol=naming", f"out={tmp_path / 'e'}", *common]) == 0
    pages = {name: (tmp_path / name / "report.html").read_text() for name in ("f", "l", "e")}
    for name in ("f", "l"):
        assert "&lt;script&gt;alert(1)&lt;" in pages[name]
    for page in pages.values():
        assert "<script" not in page
        assert "Seconds of each step" in page
    # Photographs, Gaussians, depth and features of four views.
    assert pages["f"].count("<img ") == 16
    # A picture of each word, and the scale of the colors.
    assert pages["l"].count("<img ") == 3
    rows = re.findall(r"<tr><td>([^<]*)</td>", pages["l"])
    assert rows[:2] == names[:2]
    rows = re.findall(r"<tr><td>([^<]*)</td>", pages["e"])
    assert set(names) & set(rows)


SMALL = ("demo", "objects=2", "views=2", "width=64")


def test_the_report_links_to_the_page_where_there_is_one(tmp_path, capsys, monkeypatch):
    def built() -> Bundle:
        return Bundle(script="/* the script */", style="")

    def unbuilt() -> Bundle:
        raise InputError("view: the page's script is missing")

    for name, load in (("with", built), ("without", unbuilt)):
        monkeypatch.setattr("gsencoder.app.commands.demo.load_bundle", load)
        assert cli.main([*SMALL, f"out={tmp_path / name}"]) == 0
        output = capsys.readouterr().out
        assert (tmp_path / name / "page.html").is_file() == (load is built)
        assert ('<a href="page.html">' in (tmp_path / name / "report.html").read_text()) == (load is built)
        assert ("page.html is left out: view: the page's script is missing" in " ".join(output.split())) == (
            load is unbuilt
        )
