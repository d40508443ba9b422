"""Small valid files of every kind that is read, each with what reads them: the samples of bench/fuzz.py."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import labeled_scans
import rgbd_layouts
import scene_files
import splat_samples
import test_flipped_bits

from gsencoder.core import archive
from gsencoder.core.errors import InputError
from gsencoder.data.labels.classes import read_class_list, read_label_map
from gsencoder.data.labels.expressions import read_nr3d, read_scanrefer
from gsencoder.data.labels.files import read_integer_lines, read_mask, read_split
from gsencoder.data.labels.mesh import read_mesh
from gsencoder.data.labels.questions import Question
from gsencoder.data.labels.questions import read_questions as read_labeled_questions
from gsencoder.data.labels.scans import read_axis_alignment, read_groups, read_segments
from gsencoder.data.readers.transforms_json import read_cameras, read_objects
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.splats.files import gaussians_from_raw, load_splat, read_raw
from gsencoder.data.splats.repair import inspect_splat, repair_splat
from gsencoder.evaluate.benchmarks.answers import read_answer_predictions
from gsencoder.evaluate.benchmarks.instances import read_instance_ids, read_instance_prediction
from gsencoder.evaluate.benchmarks.recognition import (
    read_recognition_labels,
    read_recognition_predictions,
)
from gsencoder.evaluate.benchmarks.referring import (
    read_referring_labels,
    read_referring_predictions,
)
from gsencoder.evaluate.benchmarks.retrieval import read_scored_pairs, read_texts, read_view_captions
from gsencoder.infer.ask.questions import read_answers, read_questions
from gsencoder.types import Scene

Read = Callable[[], object]
CORNERS = [[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (-1.0, 3.0)]
VERTICES = np.array([[0, 0, 0], [1, 2, 3], [5, 5, 5], [6, 6, 6], [9, 9, 9], [9, 9, 8]], np.float32)


@dataclass(frozen=True)
class Sample:
    """Files of one kind.

    Attributes:
        files: which may be changed.
        read: reads them, and what is read lazily as well.
        trusted: whether checksums are taken to be right whatever they are, so that what lies behind them is met.
    """

    files: tuple[Path, ...]
    read: Read
    trusted: bool = False


def splat(folder: Path, name: str) -> Sample:
    (folder / name).write_bytes(splat_samples.valid_files(folder)[name])
    path = folder / name

    def read() -> None:
        raw = read_raw(path)
        report = inspect_splat(raw)
        json.dumps(report.to_dict(), allow_nan=False)
        try:
            assert len(load_splat(path)) == len(raw), "a splat of another length"
            assert report.loadable, "loaded, and said not to be loadable"
        except InputError:
            assert not report.loadable, "not loaded, and said to be loadable"
        fixed, _ = repair_splat(raw, ["all"])
        assert len(gaussians_from_raw(fixed)) == len(fixed), "a repair of another length"

    return Sample((path,), read)


def everything_of(scene: Scene) -> None:
    views = scene.views
    if views is None:
        return
    for view in range(min(len(views), 4)):
        for name in ("images", "depths", "masks", "empty", "instances"):
            items = getattr(views, name)
            if items is not None:
                _ = items[view]


def scene(folder: Path, write: Callable[[Path], object]) -> Sample:
    root = folder / "scene"
    root.mkdir()
    write(root)
    files = tuple(sorted(path for path in folder.rglob("*") if path.is_file()))
    # TUM's files do not say them, and others need not be asked.
    options = SceneConfig(intrinsics=(30.0, 31.0, 16.0, 12.0) if (root / "groundtruth.txt").exists() else None)
    return Sample(files, lambda: everything_of(load_scene(root, options=options)))


def room(folder: Path) -> Scene:
    scene_files.write_transforms(folder / "room", depth=True)
    return load_scene(folder / "room")


def layout(folder: Path, name: str) -> Sample:
    made = room(folder)
    (folder / "in").mkdir()
    return scene(folder / "in", lambda root: rgbd_layouts.WRITERS[name](made, root))


def one(folder: Path, name: str, content: object, read: Callable[[Path], object]) -> Sample:
    """A file of JSON, text or bytes, and its reader."""
    path = folder / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return Sample((path,), lambda: read(path))


def archived(folder: Path, kind: str, *, trusted: bool) -> Sample:
    path, read = test_flipped_bits.KINDS[kind](folder)
    return Sample((path,), read, trusted)


class Any_:
    """Equal to everything."""

    def __eq__(self, other: object) -> bool:
        return True

    def __ne__(self, other: object) -> bool:
        return False

    __hash__ = None  # type: ignore[assignment]


def trust_checksums() -> Callable[[], None]:
    """Takes all checksums of archives to be right; the result undoes it."""
    before = archive.damaged_blocks, archive.file_digest
    archive.damaged_blocks, archive.file_digest = (lambda *_: ()), (lambda *_: Any_())  # type: ignore

    def undo() -> None:
        archive.damaged_blocks, archive.file_digest = before

    return undo


def npz(path: Path, **arrays: Any) -> bytes:
    np.savez(path, **arrays)
    data = path.read_bytes()
    path.unlink()
    return data


def mesh(folder: Path, *, text: bool) -> Sample:
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    path = labeled_scans.write_ply(folder / "m.ply", VERTICES, faces, labels=np.arange(6), text=text)
    return Sample((path,), lambda: read_mesh(path))


def instances(folder: Path) -> Sample:
    (folder / "predicted_masks").mkdir()
    (folder / "predicted_masks/a_000.txt").write_text("1\n0\n1\n1\n")
    (folder / "a.txt").write_text("predicted_masks/a_000.txt 4 0.5\n")
    files = (folder / "a.txt", folder / "predicted_masks/a_000.txt")
    return Sample(files, lambda: read_instance_prediction(folder / "a.txt", num_vertices=4))


def sqa3d(folder: Path) -> Sample:
    question = {"scene_id": "s0", "question_id": 1, "question": "Which?", "situation": "I stand."}
    answer = {
        "scene_id": "s0",
        "question_id": 1,
        "answers": [{"answer": "left", "answer_confidence": "yes", "answer_id": 1}],
        "position": {"x": 0.5, "y": 0.5, "z": 0},
        "rotation": {"_x": 0, "_y": 0, "_z": 0.6, "_w": 0.8},
    }
    files = folder / "questions.json", folder / "sqa_annotations.json"
    files[0].write_text(json.dumps({"questions": [question]}))
    files[1].write_text(json.dumps({"annotations": [answer]}))
    return Sample(files, lambda: read_labeled_questions(files[0]))


KEY = {"scene_id": "s0", "object_id": "3", "ann_id": "0"}
PREDICTED = KEY | {"bbox": CORNERS, "unique_multiple": 1, "others": 0}
SENTENCE = PREDICTED | {"object_name": "office_chair", "description": "The chair.", "token": ["the", "chair", "."]}
SCANQA = {"scene_id": "s0", "question_id": "q0", "question": "What?", "answers": ["chair"]}
SCANQA |= {"object_ids": [1], "object_names": ["chair"]}
QUESTION = Question(dataset="scanqa", id="q0", scene="s0", text="What?", answers=("chair",))
NR3D = (
    "assignmentid,stimulus_id,utterance,scan_id,instance_type,target_id,speaker_id,listener_id,dataset,"
    "mentions_target_class,uses_object_lang,uses_spatial_lang,uses_color_lang,uses_shape_lang,tokens,"
    "correct_guess\n"
    "1,s0-chair-2-3-4,the chair,s0,chair,3,1,2,nr3d,True,True,False,False,False,\"['the', 'chair']\",True\n"
)
CAMERA = {"cam_from_world": np.eye(4).tolist(), "fx": 500.0, "fy": 510.0, "cx": 3.5, "cy": 2.5, "width": 6, "height": 4}
OBJECT = {"id": 1, "name": "mug", "aabb_min": [0, 0, 0], "aabb_max": [1, 1, 1.5], "placed": True, "views": 3}
GROUPS = {"segGroups": [{"id": 0, "objectId": 0, "segments": [7, 8], "label": "chair"}]}
ALIGNMENT = "colorWidth = 1296\naxisAlignment = 1 0 0 2.5 0 1 0 1 0 0 1 0 0 0 0 1 \n"
MAP = "id\traw_category\tnyu40id\n1\tchair\t5\n2\ttable\t7\n"
NONE = np.zeros(3)

KINDS: dict[str, Callable[[Path], Sample]] = {
    **{
        name: (lambda folder, name=name: splat(folder, name))
        for name in ("a.ply", "a.compressed.ply", "a.spz", "v3.spz", "ascii.ply", "a.splat", "a.sog")  # type: ignore[misc]
    },
    "transforms.json": lambda f: scene(f, lambda root: scene_files.write_transforms(root, depth=True, instances=True)),
    "COLMAP, binary": lambda f: scene(f, scene_files.write_colmap),
    "COLMAP, old": lambda f: scene(f, lambda root: scene_files.write_colmap(root, old=True)),
    "COLMAP, text": lambda f: scene(f, lambda root: scene_files.write_colmap(root, text=True)),
    **{name: (lambda folder, name=name: layout(folder, name)) for name in rgbd_layouts.WRITERS},  # type: ignore[misc]
    "cameras": lambda f: one(f, "c.json", [CAMERA, CAMERA], lambda path: read_cameras(path, NONE)),
    "objects.json": lambda f: one(f, "objects.json", [OBJECT, {**OBJECT, "id": 2, "name": None}], read_objects),
    "mesh, binary": lambda f: mesh(f, text=False),
    "mesh, text": lambda f: mesh(f, text=True),
    "segments": lambda f: one(f, "s.json", {"segIndices": [7, 7, 8, 9, 9]}, read_segments),
    "groups": lambda f: one(f, "g.json", GROUPS, lambda path: read_groups(path, first_id=0)),
    "alignment": lambda f: one(f, "a.txt", ALIGNMENT, read_axis_alignment),
    "label map": lambda f: one(f, "m.tsv", MAP, lambda path: read_label_map(path, "nyu40id")),
    "class list": lambda f: one(f, "c.txt", "wall\nfloor\noffice chair\n", read_class_list),
    "split": lambda f: one(f, "s.txt", "scene0011_00\nscene0011_01\n", read_split),
    "whole numbers": lambda f: one(f, "n.txt", "4001\n4002\n0\n5001\n", read_integer_lines),
    "mask of numbers": lambda f: one(f, "n.txt", "0\n1\n1\n0\n", read_mask),
    "instance truth": lambda f: one(f, "s0.txt", "4001\n4001\n0\n5001\n", read_instance_ids),
    "instance predictions": instances,
    "instance predictions, npz": lambda f: one(
        f,
        "a.npz",
        npz(f / "x.npz", pred_masks=np.ones((4, 2), bool), pred_classes=np.array([4, 5]), pred_scores=np.ones(2)),
        lambda path: read_instance_prediction(path, num_vertices=4),
    ),
    "ScanRefer": lambda f: one(f, "s.json", [SENTENCE, SENTENCE | {"ann_id": "1"}], read_scanrefer),
    "Nr3D": lambda f: one(f, "nr3d.csv", NR3D, read_nr3d),
    "sentences, truth": lambda f: one(f, "t.json", [SENTENCE], read_referring_labels),
    "sentences, predictions": lambda f: one(f, "p.json", [PREDICTED], read_referring_predictions),
    "names, truth": lambda f: one(
        f, "t.json", [{"scene_id": "s0", "object_id": 3, "label": "chair"}], read_recognition_labels
    ),
    "names, predictions": lambda f: one(
        f, "p.json", [{"scene_id": "s0", "object_id": 3, "labels": ["chair", "bed"]}], read_recognition_predictions
    ),
    "ScanQA": lambda f: one(f, "q.json", [SCANQA], read_labeled_questions),
    "SQA3D": sqa3d,
    "answers": lambda f: one(
        f,
        "p.json",
        [{"scene_id": "s0", "question_id": "q0", "answer_top10": ["chair", "stool"]}],
        lambda path: read_answer_predictions(path, (QUESTION,)),
    ),
    "captions of views": lambda f: one(
        f, "c.json", [{"scene_id": "s0", "view": "a", "caption": "A room."}], read_view_captions
    ),
    "texts": lambda f: one(f, "t.txt", "a room\na chair\n", read_texts),
    "scored pairs": lambda f: one(
        f,
        "p.npz",
        npz(f / "x.npz", queries=np.array(["s0/a", "s0/b"]), scores=np.eye(2), distractors=np.zeros((1, 2))),
        read_scored_pairs,
    ),
    "questions": lambda f: one(
        f,
        "q.jsonl",
        '{"id": "7", "question": "What is it?", "query": ["table"]}\n'
        '{"id": 8, "question": "What is it?", "aabb": [0, 0, 0, 1, 1, 1.5], "task": "answer"}\n',
        read_questions,
    ),
    "answers of ask": lambda f: one(f, "a.jsonl", '{"id": "7", "answer": "a mug", "digest": "x"}\n', read_answers),
    **{kind: (lambda folder, kind=kind: archived(folder, kind, trusted=False)) for kind in test_flipped_bits.KINDS},  # type: ignore[misc]
    **{
        f"{kind}, checksums trusted": (lambda folder, kind=kind: archived(folder, kind, trusted=True))  # type: ignore[misc]
        for kind in test_flipped_bits.KINDS
        if kind not in ("splat of a package", "words of another program")
    },
}
