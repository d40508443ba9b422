"""The pages that commands write about their results with report=true."""

import re
from pathlib import Path

import numpy as np
import pytest

from gsencoder.app import main as cli
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.text.table import make_text_table, save_text_table

SCENE = "<script>alert(1)<"


@pytest.mark.slow
def test_fusion_words_and_scores_have_pages_in_which_names_are_text(tmp_path: Path) -> None:
    made = make_room(4, views=4, width=120, height=90)
    write_room(made, tmp_path / SCENE)
    names = sorted({each.name for each in made.objects if each.name})
    save_text_table(tmp_path / "words", make_text_table(names, np.eye(len(names), dtype=np.float32), "room"))
    common = ["report=true", "quiet=true"]
    scene, teacher = str(tmp_path / SCENE), f"teacher.words={tmp_path / 'words'}"
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


def test_without_the_option_there_is_no_page(tmp_path: Path) -> None:
    made = make_room(1, views=2, width=60, height=45)
    write_room(made, tmp_path / "room")
    assert cli.main(["fuse", str(tmp_path / "room"), "teacher=palette", f"out={tmp_path / 'f'}", "quiet=true"]) == 0
    assert not (tmp_path / "f" / "report.html").exists()
