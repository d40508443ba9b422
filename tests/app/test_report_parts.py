"""The figures of pages of results are those of the results."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from selected_rooms import selected_room, words

from gsencoder.app import main as cli
from gsencoder.app.commands import demo
from gsencoder.core.errors import InputError
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.fusion.fuse import FuseConfig, Fusion
from gsencoder.infer.localize import localize
from gsencoder.infer.page.page import Bundle
from gsencoder.teachers.labels import PaletteTeacher
from gsencoder.text.table import make_text_table, save_text_table
from gsencoder.types import Localization

SCENE, KINDS = selected_room()


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
    made = make_room(4, views=4, width=64, height=48)
    write_room(made, tmp_path / UNSAFE)
    names = sorted({each.name for each in made.objects if each.name})
    save_text_table(tmp_path / "words", make_text_table(names, np.eye(len(names), dtype=np.float32), "room"))
    common, seeds = ["report=true", "quiet=true"], "seeds.voxel=0.1"
    scene, teacher = str(tmp_path / UNSAFE), f"teacher.words={tmp_path / 'words'}"
    assert cli.main(["fuse", scene, teacher, seeds, f"out={tmp_path / 'f'}", *common]) == 0
    words = ",".join(names[:2])
    assert cli.main(["localize", str(tmp_path / "f"), f"query={words}", f"out={tmp_path / 'l'}", *common]) == 0
    assert cli.main(["evaluate", scene, teacher, seeds, "protocol=naming", f"out={tmp_path / 'e'}", *common]) == 0
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


SMALL = ("demo", "objects=2", "views=2", "width=64", "seeds.voxel=0.1")


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
