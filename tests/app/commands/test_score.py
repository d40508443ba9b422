"""`gsencoder score`, and the protocols of `evaluate` that write predictions and score them."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_runs import refusal, results_of
from forked_ranks import RankServer
from named_rooms import write_words

from gsencoder.app import main as cli
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.evaluate.benchmarks.instances import prediction_of_masks, write_instance_prediction

pytestmark = pytest.mark.slow

COMMAND = """
import sys
import gsencoder.app.commands.evaluate
from gsencoder.app import main as cli

sys.exit(cli.main())
"""
PROTOCOLS = {
    "recognition": (),
    "instances": ("protocol.proposals=truth",),
    "semantics": (),
    "referring": (),
}


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rooms and the words of all that is in them."""
    folder = tmp_path_factory.mktemp("rooms")
    made = [make_room(number, objects=4, views=4, width=120, height=90) for number in range(2)]
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
        assert (
            cli.main(["evaluate", *scenes, f"protocol={name}", words, *options, "report=true", out, "quiet=true"]) == 0
        )
    return {name: folder / name for name in PROTOCOLS}


def as_evaluated(protocol: str, evaluated: dict[str, Path]) -> tuple[str, ...]:
    """The options with which `score` takes the files as `evaluate` did."""
    return {
        "recognition": (),
        "instances": (f"classes={evaluated['instances'] / 'class_ids.csv'}",),
        "semantics": (f"classes={evaluated['semantics'] / 'class_ids.csv'}",),
        "referring": (),
    }[protocol]


def scored(protocol: str, evaluated: Path, out: Path, *options: str) -> dict[str, Any]:
    """The results of `score` on what `evaluate` wrote."""
    ending = ".json" if protocol in ("recognition", "referring") else ""
    files = [f"{name}={evaluated / name}{ending}" for name in ("predictions", "truth")]
    assert cli.main(["score", protocol, *files, *options, f"out={out}", "quiet=true"]) == 0
    return results_of(out)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_page_shows_what_the_table_holds_and_the_scenes(
    protocol: str, evaluated: dict[str, Path], tmp_path: Path
) -> None:
    scored(protocol, evaluated[protocol], tmp_path / "scored", *as_evaluated(protocol, evaluated), "report=true")
    for folder in (evaluated[protocol], tmp_path / "scored"):
        page = (folder / "report.html").read_text()
        with (folder / "table.csv").open() as stream:
            rows = list(csv.DictReader(stream))
        assert all(f"<td>{row['method']}</td>" in page for row in rows)
        assert ">room_0<" in page or not (folder / "scenes.csv").exists()


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_files_that_evaluate_writes_have_the_scores_that_it_reports(
    protocol: str, evaluated: dict[str, Path], tmp_path: Path
) -> None:
    again = scored(protocol, evaluated[protocol], tmp_path / "score", *as_evaluated(protocol, evaluated))
    first = results_of(evaluated[protocol])
    del first["gaussians"]
    assert again == first
    for name in ("scenes.csv", "table.csv"):
        given, made = ((folder / name).read_text() for folder in (evaluated[protocol], tmp_path / "score"))
        assert made.replace("predictions", "fused") == given


def test_features_that_were_fused_from_the_labels_name_nearly_all_that_is_there(evaluated: dict[str, Path]) -> None:
    assert results_of(evaluated["recognition"])["mean_1"] == 1.0
    assert results_of(evaluated["semantics"])["miou"] > 0.9
    assert results_of(evaluated["referring"])["acc_25"] >= 0.75
    # True objects as masks, which are named rightly.
    instances = results_of(evaluated["instances"])
    assert instances["ap_25"] == instances["ap_50"] == instances["ap"] == 1
    assert instances["spread"]["ap"]["scenes"] == 2


@pytest.mark.parametrize(("protocol", "count"), [("instances", 3), ("referring", 2)])
def test_processes_that_share_the_scenes_score_each_of_them_once(
    protocol: str, count: int, rooms: Path, evaluated: dict[str, Path], tmp_path: Path, ranks: RankServer
) -> None:
    scenes = [str(rooms / f"room_{number}") for number in range(2)]
    options = [f"protocol={protocol}", f"teacher.words={rooms / 'words.safetensors'}", *PROTOCOLS[protocol]]
    words = ["evaluate", *scenes, *options, f"out={tmp_path / 'out'}", "quiet=true"]
    script = tmp_path / "run.py"
    script.write_text(COMMAND)
    ranks.started(script, *words, count=count).end_well()
    assert results_of(tmp_path / "out") == results_of(evaluated[protocol])


def test_the_papers_rows_stand_below_the_measured_ones(evaluated: dict[str, Path]) -> None:
    with (evaluated["instances"] / "table.csv").open(newline="") as stream:
        sources = [row["source"] for row in csv.DictReader(stream)]
    assert sources[0] == "measured"
    assert set(sources[1:]) == {"published"}
    assert (
        "| SplatDistill, fused (published) | 28.1 | 24.3 | 19.1 |" in (evaluated["instances"] / "table.md").read_text()
    )


def test_masks_of_another_scene_or_of_another_length_are_refused(
    evaluated: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth, classes = evaluated["instances"] / "truth", evaluated["instances"] / "class_ids.csv"
    words = ["score", "instances", f"truth={truth}", f"classes={classes}", f"out={tmp_path / 'out'}"]
    (tmp_path / "masks").mkdir()
    for name in ("room_0", "room_1"):
        mask = prediction_of_masks(name, np.ones((1, 7), bool), [1], [0.5], num_vertices=7)
        write_instance_prediction(tmp_path / "masks", mask)
    assert "room_0" in refusal(capsys, *words, f"predictions={tmp_path / 'masks'}")
    (tmp_path / "masks" / "room_1.txt").rename(tmp_path / "masks" / "room_9.txt")
    assert "room_9" in refusal(capsys, *words, f"predictions={tmp_path / 'masks'}")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["answerz"], "expected one protocol, instances, semantics, recognition, referring"),
        (["instances"], "classes= is missing"),
        (["instances", "classes=scannet21"], "classes: scannet21 is no file; expected scannet20, scannet200"),
        (["recognition", "min_iou=0.25"], "min_iou: recognition has no such setting; it takes classes, allow_missing"),
        (["semantics", "classes=scannet20", "java=false"], "java: semantics has no such setting"),
        (["captions", "min_iou=1.5"], "min_iou: expected 0 to 1, got 1.5"),
        (["retrieval", "distractors=-1"], "distractors: expected 0 or more, got -1"),
    ],
)
def test_settings_that_do_not_fit_the_protocol_are_refused(
    words: list[str], message: str, evaluated: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = evaluated["instances"]
    assert message in refusal(capsys, "score", *words, f"predictions={folder / 'predictions'}", f"truth={folder}/truth")


def test_predictions_and_truth_that_are_swapped_are_refused(
    evaluated: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    for protocol in ("recognition", "referring"):
        swapped = [f"predictions={evaluated[protocol]}/truth.json", f"truth={evaluated[protocol]}/predictions.json"]
        assert "may be swapped" in refusal(capsys, "score", protocol, *swapped)


def test_a_missing_prediction_is_refused_or_counts_as_wrong(
    evaluated: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = json.loads((evaluated["recognition"] / "predictions.json").read_text())
    (tmp_path / "some.json").write_text(json.dumps(rows[1:]))
    words = [
        "score",
        "recognition",
        f"predictions={tmp_path / 'some.json'}",
        f"truth={evaluated['recognition'] / 'truth.json'}",
    ]
    assert "has no prediction" in refusal(capsys, *words)
    assert cli.main([*words, "allow_missing=true", f"out={tmp_path / 'out'}", "quiet=true"]) == 0
    results = results_of(tmp_path / "out")
    assert results["unanswered"] == 1
    assert results["overall_1"] == pytest.approx(1 - 1 / len(rows))
