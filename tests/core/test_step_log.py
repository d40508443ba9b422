"""The log: one line a row, columns that may come later, and no line twice."""

from pathlib import Path

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.core.logs import LOG_FILE, Log, read_log


def test_columns_may_be_added_on_the_way(tmp_path: Path) -> None:
    log = Log(tmp_path, done=0, events=False)
    log.add(0, {"loss": 1.0})
    log.add(1, {"loss": 0.5, "score": 0.9})
    log.add(2, {"loss": 0.4})
    assert (tmp_path / LOG_FILE).read_text() == "step,loss,score\n0,1.0,\n1,0.5,0.9\n2,0.4,\n"


def test_a_continued_log_has_every_step_once(tmp_path: Path) -> None:
    log = Log(tmp_path, done=0, events=False)
    for step in range(1, 5):
        log.add(step, {"loss": float(step)})
    with (tmp_path / LOG_FILE).open("a") as stream:
        stream.write("5,3.")  # What a kill in the middle of a line leaves.
    again = Log(tmp_path, done=2, events=False)
    again.add(3, {"loss": 9.0})
    assert [row["loss"] for row in read_log(tmp_path / LOG_FILE)] == ["1.0", "2.0", "9.0"]


def test_a_file_that_is_no_log_is_refused(tmp_path: Path) -> None:
    (tmp_path / LOG_FILE).write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match=r"log\.csv: cannot be continued"):
        Log(tmp_path, done=1, events=False)


def test_events_and_pictures_are_written_for_tensorboard(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    log = Log(tmp_path, done=0, events=True)
    log.add(0, {"loss": 1.0})
    log.picture(0, "validation/sheet", np.zeros((4, 4, 3), np.uint8))
    assert list((tmp_path / "tensorboard").glob("events*"))
    assert shown(tmp_path / "tensorboard") == [(0, 1.0)]
    assert (tmp_path / "validation" / "sheet_000000.png").is_file()


def shown(folder: Path) -> list[tuple[int, float]]:
    """The losses that TensorBoard reads from a folder."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    read = EventAccumulator(str(folder))
    read.Reload()
    return [(event.step, event.value) for event in read.Scalars("loss")]


def test_tensorboard_shows_the_steps_of_a_continued_run_once(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    log = Log(tmp_path, done=0, events=True)
    for step in range(1, 5):
        log.add(step, {"loss": float(step)})
    again = Log(tmp_path, done=2, events=True, begun=True)
    for step in range(3, 6):
        again.add(step, {"loss": 10.0 * step})
    assert shown(tmp_path / "tensorboard") == [(1, 1.0), (2, 2.0), (3, 30.0), (4, 40.0), (5, 50.0)]
