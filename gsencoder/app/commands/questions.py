"""`gsencoder questions SCENE… out=FOLDER`: questions, situations and expressions with their answers, from labels."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

from gsencoder.app.options import CommonConfig
from gsencoder.app.run import Run
from gsencoder.core.errors import counted
from gsencoder.core.process import Track
from gsencoder.core.settings import option
from gsencoder.data.labels.expressions import write_scanrefer
from gsencoder.data.labels.made_questions import (
    KINDS,
    kind_of,
    make_expressions,
    make_questions,
    make_situations,
)
from gsencoder.data.labels.questions import write_scanqa, write_sqa3d
from gsencoder.data.labels.seen_objects import SeenScene, see_objects
from gsencoder.data.scenes import SceneConfig, check_names, find_scenes, load_scene

QUESTIONS, EXPRESSIONS, SITUATED = "questions.json", "expressions.json", "situated_questions.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class QuestionsConfig(CommonConfig):
    """Settings of `questions`."""

    paths: tuple[str, ...] = option(
        (),
        "scenes with photographs, instance maps and objects.json, or folders of such",
        metavar="SCENE",
        required=True,
    )
    seed: int = option(0, "of the choice among all questions that can be asked", ge=0)
    per_kind: int = option(10, "most questions of a kind about a scene", ge=2)
    min_pixels: int = option(
        200, "pixels that some photograph shows of an object before anything is asked about it", ge=1
    )
    per_object: int = option(3, "most expressions that mean one object", ge=1)
    objects: int = option(0, "most objects of a scene with expressions; 0 = all", ge=0)
    data: SceneConfig = field(default_factory=SceneConfig)


def run(config: QuestionsConfig, run: Run) -> None:
    """Reads the labels of all scenes and writes what can be asked as ScanQA, SQA3D and ScanRefer write it."""
    out = run.out("questions")
    with run.folder(out) as folder:
        with run.step("labels"):
            scenes = list(_seen(config, run.track))
        with run.step("make"):
            questions = make_questions(scenes, seed=config.seed, per_kind=config.per_kind)
            situations = make_situations(scenes, seed=config.seed, per_kind=config.per_kind)
            expressions = make_expressions(
                scenes, seed=config.seed, per_object=config.per_object, per_scene=config.objects
            )
        write_scanqa(folder / QUESTIONS, questions)
        write_sqa3d(folder / SITUATED, situations)
        write_scanrefer(folder / EXPRESSIONS, expressions)
        counts = Counter(kind_of(each) for each in questions)
        kinds = {kind: counts[kind] for kind in KINDS}
        situated = Counter(each.id.rsplit("-", 2)[1] for each in situations)
        unique = sum(not each.multiple for each in expressions)
        run.results.update(
            scenes=[scene.name for scene in scenes],
            questions=len(questions),
            kinds=kinds,
            answers=dict(Counter(each.answers[0] for each in questions).most_common()),
            situated=len(situations),
            situated_kinds=dict(situated),
            expressions=len(expressions),
            unique_expressions=unique,
            described_objects=len({each.key[:2] for each in expressions}),
            files=[QUESTIONS, SITUATED, EXPRESSIONS],
        )
    for kind, count in (kinds | dict(situated)).items():
        run.print(f"{kind:>10}: {counted(count, 'question')}")
    run.print(
        f"{out}: {counted(len(questions), 'question')}, {len(situations)} situated, "
        f"{counted(len(expressions), 'expression')}"
    )


def _seen(config: QuestionsConfig, track: Track) -> Iterator[SeenScene]:
    paths = find_scenes(config.paths)
    check_names(paths)
    for path in track(paths, "scenes"):
        yield see_objects(load_scene(path, options=config.data), config.min_pixels)
