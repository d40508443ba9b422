"""What has been measured, in a file that an interrupted sweep is continued from."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError, readable
from gsencoder.core.files import MODEL_BYTES, is_full_disk, plain, read_foreign, write_bytes
from gsencoder.core.settings import describe_values
from gsencoder.evaluate.tradeoff.stage import Judged, Score

RECORDS_FILE, IDENTITY_FILE = "measured.jsonl", "sweep.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """One timed run.

    Attributes:
        seconds: wall-clock time.
        cpu_seconds: of all threads of the process.
        mib: growth of peak resident memory; NaN where the system does not report it.
    """

    seconds: float
    cpu_seconds: float
    mib: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """What was measured of one setting on one scene.

    Attributes:
        stage: its name.
        scene: its name.
        knobs: the values that differ from the stage's base.
        timings: one a round.
        judged: None until its product has been judged.
    """

    stage: str
    scene: str
    knobs: Mapping[str, Any]
    timings: tuple[Timing, ...] = ()
    judged: Judged | None = None

    @property
    def label(self) -> str:
        return describe_values(self.knobs)

    @property
    def scores(self) -> Mapping[str, Score]:
        return {} if self.judged is None else self.judged.scores

    @property
    def bytes(self) -> int:
        return 0 if self.judged is None else self.judged.bytes

    def is_complete(self, rounds: int) -> bool:
        return self.judged is not None and len(self.timings) >= rounds


def record_key(stage: str, scene: str, knobs: Mapping[str, Any]) -> tuple[str, str, str]:
    """What tells records apart: the order of the knobs does not."""
    return stage, scene, json.dumps(plain(dict(knobs)), sort_keys=True)


class Records:
    """Records by stage, scene and knobs; where there is a folder, each measurement is written to a file of it at once.

    A line of the file is one timing of a setting, or what its product is worth.
    """

    def __init__(self, folder: Path | None = None, identity: Mapping[str, Any] = {}) -> None:
        """Args:
        folder: holds what an earlier run of the same sweep measured, or nothing; None = nothing is written.
        identity: what runs must share to be one sweep, as JSON values.

        Raises:
            InputError: the folder holds records of another sweep, or damaged ones. One in which nothing was measured is
                of no sweep.
        """
        self._by_key: dict[tuple[str, str, str], Record] = {}
        self._path = None if folder is None else folder / RECORDS_FILE
        if folder is None:
            return
        self._identity = json.dumps(plain(dict(identity)), sort_keys=True).encode()
        path = folder / IDENTITY_FILE
        with readable(path):
            other = path.is_file() and read_foreign(path) != self._identity
        if other and (folder / RECORDS_FILE).is_file():
            raise InputError(
                f"{folder}: holds measurements of a sweep with other settings; give resume=false to begin anew, or "
                "another out="
            )
        self._read()

    def _read(self) -> None:
        assert self._path is not None
        if not self._path.is_file():
            return
        # A kill may have left an incomplete last line, which is measured again.
        with readable(self._path):
            complete = read_foreign(self._path, MODEL_BYTES).rpartition(b"\n")
        lines = complete[0].splitlines()
        for number, line in enumerate(lines, start=1):
            try:
                values = json.loads(line)
                key = values["stage"], values["scene"], values["knobs"]
                if "timing" in values:
                    numbers = {name: _number(value) for name, value in values["timing"].items()}
                    self._add_timing(*key, Timing(**numbers))
                else:
                    scores = {name: Score(*map(_number, score)) for name, score in values["scores"].items()}
                    self._add_judged(*key, Judged(scores=scores, bytes=int(values["bytes"])))
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise InputError(
                    f"{self._path}: line {number} is damaged ({error}); give resume=false to begin anew"
                ) from error
        if complete[2]:
            write_bytes(self._path, b"".join(line + b"\n" for line in lines))

    def __len__(self) -> int:
        return len(self._by_key)

    def get(self, stage: str, scene: str, knobs: Mapping[str, Any]) -> Record:
        """What was measured of a setting on a scene; an empty record if nothing was."""
        empty = Record(stage=stage, scene=scene, knobs=dict(knobs))
        return self._by_key.get(record_key(stage, scene, knobs), empty)

    def add_timing(self, stage: str, scene: str, knobs: Mapping[str, Any], timing: Timing) -> None:
        """Adds a timed run.

        Raises:
            InputError: the disk is full.
        """
        self._add_timing(stage, scene, knobs, timing)
        self._append({"stage": stage, "scene": scene, "knobs": knobs, "timing": asdict(timing)})

    def add_judged(self, stage: str, scene: str, knobs: Mapping[str, Any], judged: Judged) -> None:
        """Adds what a product is worth.

        Raises:
            InputError: the disk is full.
        """
        self._add_judged(stage, scene, knobs, judged)
        scores = {name: list(score) for name, score in judged.scores.items()}
        self._append({"stage": stage, "scene": scene, "knobs": knobs, "scores": scores, "bytes": judged.bytes})

    def _add_timing(self, stage: str, scene: str, knobs: Mapping[str, Any], timing: Timing) -> None:
        before = self.get(stage, scene, knobs)
        self._by_key[record_key(stage, scene, knobs)] = replace(before, timings=(*before.timings, timing))

    def _add_judged(self, stage: str, scene: str, knobs: Mapping[str, Any], judged: Judged) -> None:
        before = self.get(stage, scene, knobs)
        self._by_key[record_key(stage, scene, knobs)] = replace(before, judged=judged)

    def _append(self, line: Mapping[str, Any]) -> None:
        if self._path is None:
            return
        if not self._path.is_file():
            write_bytes(self._path.with_name(IDENTITY_FILE), self._identity)
        try:
            # The file is closed after every line, so that a kill loses none.
            with self._path.open("ab") as stream:
                stream.write(json.dumps(plain(dict(line))).encode() + b"\n")
        except OSError as error:
            problem = "no space left on the device" if is_full_disk(error) else error.strerror or error
            raise InputError(f"{self._path}: cannot write: {problem}") from error


def _number(value: float | int | None) -> float:
    """A number as it was; those that were not finite were written as null."""
    return math.nan if value is None else float(value)
