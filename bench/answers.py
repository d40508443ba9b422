"""Questions answered by a scripted model that knows what each picture shows: the ceiling of views, marks and scores.

    python bench/answers.py SCENE … [--counts 4,8,16,32] [--per-kind 6] [--objects 8] [--seed 0] [--out FILE.json]
                            [--features FOLDER [--space labels]]
    python bench/answers.py --unlabeled FEATURES --words table,chair [--photos SCENE] [--counts 8]

Questions and expressions are made from the labels of each scene, and asked of fused features of the labels teacher
with the photographs of the scene, or of those that --features holds for each scene. Views are chosen greedily or are
evenly spread frames. A question is answered rightly where some picture shows 200 pixels or more of each object that it
is about; absence needs nothing to be seen. Seconds are of looking up words, choosing views and making pictures
("views", by the clock and of all cores), and of the request to a server on this machine; bytes are those of its JSON.

Without labels nothing is right or wrong. With --unlabeled, "Where is the WORD?" is asked, the boxes that localize finds
stand in for objects, and the figure is the share of words whose best box is shown by 200 pixels or more in some
picture: that of the choice of views, given the boxes, and no accuracy.
"""

import argparse
import json
import sys
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from scripted_answerer import (
    LEAST_WEIGHT,
    MIN_PIXELS,
    MODEL,
    AnswerSheet,
    Fact,
    PictureTruth,
    ScriptedAnswerer,
    SentPicture,
    add_expressions,
    add_questions,
    request_digest,
    request_pictures,
    serving,
)

from gsencoder.app.inputs import stored_words, with_stored_features
from gsencoder.app.scenes import load_words
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import write_json
from gsencoder.core.pretrained import find_file
from gsencoder.data.labels.expressions import Expression
from gsencoder.data.labels.made_questions import KINDS, QuestionsConfig, kind_of, make_expressions, make_questions
from gsencoder.data.labels.questions import Question as TruthQuestion
from gsencoder.data.labels.seen_objects import see_objects
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.evaluate.boxes import aabb_iou
from gsencoder.fusion.folder import load_features
from gsencoder.fusion.fuse import fuse
from gsencoder.infer.ask.ask import Asker, Prompt, Question, chosen_mark, prompt_messages
from gsencoder.infer.ask.batch import short_answer, targets_to_json
from gsencoder.infer.ask.server import VlmConfig, VlmServer, request_body
from gsencoder.infer.localize import select_features
from gsencoder.infer.views.photographs import with_photographs
from gsencoder.infer.views.pictures import views_to_json
from gsencoder.infer.views.targets import ViewsConfig
from gsencoder.render import blend
from gsencoder.teachers.build import build_teacher
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.text.table import load_text_table
from gsencoder.text.vocabulary import words_of_table
from gsencoder.types import Scene

WORDS = "clip_vitb32_names.npz"
METHODS: tuple[Literal["greedy", "uniform"], ...] = ("greedy", "uniform")
IOUS = (0.25, 0.5)
CANDIDATES = 32

Register = Callable[[Question, Prompt, Sequence[Mapping[str, Any]], tuple[str, ...]], None]
"""Tells the answerer what the pictures of a question show: rows of the views, and digests of the pictures."""


class Tally:
    """What one setting gave."""

    def __init__(self) -> None:
        self.right: dict[str, list[bool]] = defaultdict(list)
        self.ious: list[float] = []
        self.seconds: dict[str, float] = defaultdict(float)
        self.bytes: list[int] = []
        self.pictures: list[int] = []
        self.failed, self.processor_seconds = 0, 0.0

    def figures(self) -> dict[str, Any]:
        """All of it as JSON values."""
        answers = [each for kind in KINDS for each in self.right[kind]]
        asked = max(len(self.bytes), 1)
        return {
            "questions": len(answers),
            "em": share(answers),
            **{f"em_{kind}": share(self.right[kind]) for kind in KINDS},
            "expressions": len(self.ious),
            **{f"acc_{k}": share([iou >= k for iou in self.ious]) for k in IOUS},
            "shown": share(self.right["shown"]),
            "not_asked": self.failed,
            "pictures_a_question": float(np.mean(self.pictures or [0])),
            "bytes_a_question": float(np.mean(self.bytes or [0])),
            **{f"seconds_{step}": seconds / asked for step, seconds in self.seconds.items()},
            "processor_seconds_views": self.processor_seconds / asked,
            "questions_a_second": len(self.bytes) / max(sum(self.seconds.values()), 1e-9),
        }


def share(good: Sequence[bool]) -> float | None:
    """The share of what is good; None of nothing."""
    return float(np.mean(good)) if good else None


def send(question: Question, asker: Asker, server: VlmServer, register: Register, tally: Tally) -> tuple[str, Prompt]:
    """Asks one question, and adds seconds and bytes to the tally; the truth of its pictures is registered between."""
    begun, used = time.perf_counter(), time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)
        prompt = asker.prompt(question)
    body = request_body(prompt_messages(prompt, asker.vlm), asker.vlm)
    tally.seconds["views"] += time.perf_counter() - begun
    tally.processor_seconds += time.process_time() - used
    tally.bytes.append(len(json.dumps(body)))
    tally.pictures.append(len(prompt.pictures))
    register(question, prompt, views_to_json(asker.scene, prompt.views), request_pictures(body))
    begun = time.perf_counter()
    text = server.ask(body).text
    tally.seconds["request"] += time.perf_counter() - begun
    return text, prompt


def measure(
    asker: Asker,
    server: VlmServer,
    register: Register,
    questions: Iterable[TruthQuestion],
    expressions: Iterable[Expression],
    tally: Tally,
) -> None:
    """Asks all questions and expressions of a scene."""
    for each in questions:
        text, _ = send(Question(text=each.text), asker, server, register, tally)
        tally.right[str(kind_of(each))].append(short_answer(text) in each.answers)
    for one in expressions:
        question = Question(text=one.text, task="ground")
        try:
            text, prompt = send(question, asker, server, register, tally)
        except InputError:  # No word of the description has a box, or no mark is in sight.
            tally.failed += 1
            tally.ious.append(0.0)
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SceneWarning)
            mark = chosen_mark(prompt, text)
        iou = 0.0
        if mark and one.aabb is not None:
            box = targets_to_json(question, prompt)[mark - 1]
            corners = (*(np.array(box[name]) for name in ("aabb_min", "aabb_max")), *map(np.array, one.aabb))
            iou = aabb_iou(*corners)
        tally.ious.append(iou)


def labeled_scene(path: str, stored: str, space: str) -> tuple[Scene, Any]:
    """A scene with stored features, or fused ones of the labels teacher, and the words that lead into them."""
    if stored:
        scene = load_scene(path)
        [(scene, _)] = with_stored_features([(scene, 0.0)], stored, space=space)
        return scene, stored_words(stored, scene.name, space=space)
    table = load_text_table(find_file(WORDS, "words"))
    scene = with_gaussians(load_scene(path))
    features = fuse(scene, build_teacher(LabelsConfig(words=WORDS), scene, table)).features
    return replace(scene, features={features.space.name: features}), words_of_table(table)


def labeled(paths: Sequence[str], settings: argparse.Namespace, vlm: VlmConfig) -> dict[str, dict[str, Any]]:
    """The table of labeled scenes."""
    tallies: dict[str, Tally] = defaultdict(Tally)
    seen = [see_objects(load_scene(path)) for path in paths]
    questions = make_questions(seen, QuestionsConfig(seed=settings.seed, per_kind=settings.per_kind))
    made = make_expressions(seen, seed=settings.seed, per_object=1, per_scene=settings.objects)
    expressions = [each.expression for each in made]
    for path in paths:
        scene, words = labeled_scene(path, settings.features, settings.space)
        truth, sheet = PictureTruth(scene, scene), AnswerSheet()
        add_questions(sheet, questions)
        add_expressions(sheet, expressions)
        answerer = ScriptedAnswerer(sheet)

        def register(
            question: Question, prompt: Prompt, rows: Sequence[Mapping[str, Any]], digests: tuple[str, ...],
            truth: PictureTruth = truth, sheet: AnswerSheet = sheet,
        ) -> None:  # fmt: skip
            for digest, row in zip(digests, rows, strict=True):
                sheet.pictures[digest] = SentPicture(scene=truth.scene.name, pixels=truth.pixels(row))
            targets = targets_to_json(question, prompt)
            sheet.marks[request_digest(digests)] = tuple(
                truth.instance_in(box["aabb_min"], box["aabb_max"]) for box in targets
            )

        with serving(answerer) as url:
            server = VlmServer(replace(vlm, base_url=url))
            for count, method in [(count, method) for count in settings.counts for method in METHODS]:
                views = ViewsConfig(method=method, count=count, candidates=max(CANDIDATES, count))
                asker = Asker(scene, words, views=views, vlm=vlm)
                own = [each for each in questions if each.scene == scene.name]
                described = [each for each in expressions if each.scene == scene.name]
                tally = tallies[f"{method} {count}"]
                measure(asker, server, register, own, described, tally)
                print(f"{scene.name} {method} {count}: {one_line(tally.figures())}", flush=True)
        assert answerer.unknown_pictures == answerer.unknown_questions == 0
    return {name: tally.figures() for name, tally in tallies.items()}


def unlabeled(settings: argparse.Namespace, vlm: VlmConfig) -> dict[str, dict[str, Any]]:
    """The table of a scene without labels: what pictures show of the boxes that words have."""
    folder = Path(settings.unlabeled)
    scene = load_features(folder)
    if settings.photos:
        scene = with_photographs(scene, load_scene(settings.photos))
    words = load_words(folder, select_features(scene, None)[1].space, "")
    sheet = AnswerSheet()
    assert scene.gaussians is not None
    gaussians = scene.gaussians

    def register(_: Question, prompt: Prompt, __: Sequence[Mapping[str, Any]], digests: tuple[str, ...]) -> None:
        mask = torch.zeros(len(gaussians), 1)
        if prompt.targets:
            mask[torch.from_numpy(prompt.targets[0].rows.astype(np.int64))] = 1
        for view, digest in enumerate(digests):
            shown = blend(gaussians, prompt.views.cameras, view).render(mask)[:, 0]
            sheet.pictures[digest] = SentPicture(
                scene=scene.name, pixels={1: int((shown >= LEAST_WEIGHT).sum()) if prompt.targets else 0}
            )

    answerer, tallies = ScriptedAnswerer(sheet), {}
    with serving(answerer) as url:
        server = VlmServer(replace(vlm, base_url=url))
        for count, method in [(count, method) for count in settings.counts for method in METHODS]:
            views = ViewsConfig(method=method, count=count, candidates=max(CANDIDATES, count))
            asker = Asker(scene, words, views=views, vlm=vlm)
            tally = tallies[f"{method} {count}"] = Tally()
            for word in settings.words:
                text = f"Where is the {word}?"
                sheet.facts[scene.name, text] = Fact(answer="shown", needed=(1,))
                answer, _ = send(Question(text=text, query=(word,)), asker, server, register, tally)
                tally.right["shown"].append(answer == "shown")
            print(f"{scene.name} {method} {count}: {one_line(tally.figures())}", flush=True)
    return {name: tally.figures() for name, tally in tallies.items()}


def one_line(figures: Mapping[str, Any]) -> str:
    """Figures on one line."""
    return ", ".join(
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in figures.items()
        if value is not None
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--counts", default="4,8,16,32", type=lambda text: [int(each) for each in text.split(",")])
    parser.add_argument("--per-kind", default=6, type=int)
    parser.add_argument("--objects", default=8, type=int)
    parser.add_argument("--seed", default=0, type=int)
    parser.add_argument("--features", default="", help="folder of the features of each scene, as evaluate takes it")
    parser.add_argument("--space", default="", help="name of the features where there are several")
    parser.add_argument("--unlabeled", default="")
    parser.add_argument("--words", default=[], type=lambda text: text.split(","))
    parser.add_argument("--photos", default="")
    parser.add_argument("--out", default="")
    settings = parser.parse_args()
    if bool(settings.scenes) == bool(settings.unlabeled) or bool(settings.unlabeled) != bool(settings.words):
        parser.error("give labeled scenes, or --unlabeled FEATURES with --words")
    vlm = VlmConfig(model=MODEL, key="none")
    begun = time.process_time()
    table = unlabeled(settings, vlm) if settings.unlabeled else labeled(settings.scenes, settings, vlm)
    print(f"seen: an object of {MIN_PIXELS} pixels or more; {time.process_time() - begun:.0f} s of one core")
    for name, figures in table.items():
        print(f"{name}: {one_line(figures)}")
    if settings.out:
        write_json(settings.out, table)


if __name__ == "__main__":
    main()
