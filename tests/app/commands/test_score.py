"""`gsencoder score`, and the protocols of `evaluate` that write predictions and score them."""

import csv
from pathlib import Path
from typing import Any

import pytest
from command_runs import refusal, results_of
from named_rooms import write_words

from gsencoder.app import main as cli
from gsencoder.data.synthetic import make_room, write_room

pytestmark = pytest.mark.slow

COMMAND = """
import sys
import gsencoder.app.commands.evaluate
from gsencoder.app import main as cli

sys.exit(cli.main())
"""
PROTOCOLS = {"recognition": (), "instances": ("protocol.proposals=truth",), "semantics": (), "referring": ()}
SEEDS = "seeds.voxel=0.05"


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rooms and the words of all that is in them."""
    folder = tmp_path_factory.mktemp("rooms")
    made = [make_room(number, objects=4, views=3, width=96, height=72) for number in range(2)]
    for number, room in enumerate(made):
        write_room(room, folder / f"room_{number}")
    write_words(folder / "words.safetensors", *made)
    return folder


@pytest.fixture(scope="module")
def evaluated(rooms: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The outputs of `evaluate` by protocol."""
    folder = tmp_path_factory.mktemp("evaluated")
    scenes = [str(rooms / f"room_{number}") for number in range(2)]
    words = f"teacher.words={rooms / 'words.safetensors'}"
    for name, options in PROTOCOLS.items():
        out = f"out={folder / name}"
        command = ["evaluate", *scenes, f"protocol={name}", words, SEEDS, *options]
        assert cli.main([*command, "report=true", out, "quiet=true"]) == 0
    return {name: folder / name for name in PROTOCOLS}


def scored(protocol: str, evaluated: Path, out: Path, *options: str) -> dict[str, Any]:
    """The results of `score` on what `evaluate` wrote."""
    ending = ".json" if protocol in ("recognition", "referring") else ""
    files = [f"{name}={evaluated / name}{ending}" for name in ("predictions", "truth")]
    assert cli.main(["score", protocol, *files, *options, f"out={out}", "quiet=true"]) == 0
    return results_of(out)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_files_and_pages_that_evaluate_writes_have_the_scores_that_it_reports(protocol, evaluated, tmp_path):
    out = tmp_path / "score"
    has_classes = protocol in ("instances", "semantics")
    classes = [f"classes={evaluated[protocol] / 'class_ids.csv'}"] if has_classes else []
    again = scored(protocol, evaluated[protocol], out, *classes, "report=true")
    first = results_of(evaluated[protocol])
    del first["gaussians"]
    assert again == first
    for name in ("scenes.csv", "table.csv"):
        given, made = ((folder / name).read_text() for folder in (evaluated[protocol], out))
        assert made.replace("predictions", "fused") == given
    for folder in (evaluated[protocol], out):
        page = (folder / "report.html").read_text()
        with (folder / "table.csv").open() as stream:
            rows = list(csv.DictReader(stream))
        assert all(f"<td>{row['method']}</td>" in page for row in rows)
        assert ">room_0<" in page
        # Rows of papers stand below the measured ones.
        sources = [row["source"] for row in rows]
        assert sources == sorted(sources)


def test_features_that_were_fused_from_the_labels_name_nearly_all_that_is_there(evaluated: dict[str, Path]) -> None:
    assert results_of(evaluated["recognition"])["mean_1"] == 1.0
    assert results_of(evaluated["semantics"])["miou"] > 0.9
    assert results_of(evaluated["referring"])["acc_25"] >= 0.75
    # True objects as masks, which are named rightly.
    instances = results_of(evaluated["instances"])
    assert instances["ap_25"] == instances["ap_50"] == instances["ap"] == 1
    assert instances["spread"]["ap"]["scenes"] == 2


@pytest.mark.parametrize(("protocol", "count"), [("instances", 3)])
def test_processes_that_share_the_scenes_score_each_of_them_once(protocol, count, rooms, evaluated, tmp_path, ranks):
    scenes = [str(rooms / f"room_{number}") for number in range(2)]
    options = [f"protocol={protocol}", f"teacher.words={rooms / 'words.safetensors'}", SEEDS, *PROTOCOLS[protocol]]
    words = ["evaluate", *scenes, *options, f"out={tmp_path / 'out'}", "quiet=true"]
    script = tmp_path / "run.py"
    script.write_text(COMMAND)
    ranks.started(script, *words, count=count).end_well()
    assert results_of(tmp_path / "out") == results_of(evaluated[protocol])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["answerz"], "expected one protocol, instances, semantics, recognition, referring"),
        (["instances"], "classes= is missing"),
        (["instances", "classes=scannet21"], "classes: scannet21 is no file; expected scannet20, scannet200"),
        (["recognition", "min_iou=0.25"], "min_iou: recognition has no such setting; it takes classes, allow_missing"),
        (["semantics", "classes=scannet20", "java=false"], "java: semantics has no such setting"),
    ],
)
def test_settings_that_do_not_fit_the_protocol_are_refused(words, message, evaluated, capsys):
    folder = evaluated["instances"]
    assert message in refusal(capsys, "score", *words, f"predictions={folder / 'predictions'}", f"truth={folder}/truth")
