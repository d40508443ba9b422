"""Every command that writes, as short as it runs: what faults are put into, and the inputs that they all read."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

TRAIN = (
    "train.steps=3", "train.warmup=1", "train.log_every=1", "train.checkpoint_every=0",
    "train.validate_every=0", "sampling.gaussians=600", "sampling.smallest=200", "model.voxel=0.2",
    "model.transformer.encoder_depths=[1,1]", "model.transformer.encoder_channels=[16,16]",
    "model.transformer.decoder_depths=[1]", "model.transformer.decoder_channels=[16]",
    "model.transformer.head_channels=16", "model.transformer.patch=32", "seeds.voxel=0.1",
)  # fmt: skip
VIEWS = ("choose.source=frames", "choose.candidates=4", "choose.count=2")
QUESTION = "Where is the cube?"
ROOMS = ("room_a", "room_b")


@dataclass(frozen=True)
class Case:
    """A command line without out=, and what is true of it."""

    words: Callable[[Path], list[str]]
    out: str = "out"
    beside: tuple[str, ...] = ()
    """What else may stay beside out= after a run that ended, and what of an unfinished one is read again."""
    server: bool = False
    """Whether it asks a server of chat."""
    several: bool = False
    """Whether it is of several scenes, each with a folder in out=."""
    packages: tuple[str, ...] = ()
    other: tuple[str, ...] = ()
    """Settings with which it writes other results, as a second run of it in the same folder."""


def _fuse(given: Path, *more: str) -> list[str]:
    return ["fuse", str(given / "room"), f"teacher.words={given / 'words.safetensors'}", "seeds.voxel=0.1", *more]


def _of_room(command: str, *more: str) -> Callable[[Path], list[str]]:
    return lambda given: [command, str(given / "room"), *more]


def _of_features(command: str, *more: str) -> Callable[[Path], list[str]]:
    return lambda given: [command, str(given / "features"), *more]


def _words(given: Path) -> str:
    return f"teacher.words={given / 'words.safetensors'}"


CASES: dict[str, Case] = {
    "fuse": Case(lambda given: _fuse(given), other=("fusion.views=2",)),
    "fuse with a report": Case(lambda given: _fuse(given, "report=true")),
    "fuse several": Case(lambda given: ["fuse", str(given / "rooms"), _words(given), "seeds.voxel=0.1"], several=True),
    "encode": Case(_of_room("encode", "weights=GIVEN/trained", "seeds.voxel=0.1"), other=("data.max_views=2",)),
    "train": Case(
        lambda given: ["train", str(given / "room"), _words(given), "tensorboard=true", *TRAIN],
        beside=("out.prepared",),
        other=("train.seed=1",),
    ),
    "reconstruct": Case(
        _of_room(
            "reconstruct", "optimize.steps=3", "holdout=3", "seeds.voxel=0.15", "optimize.sh_degree=0",
            "checkpoint_every=0",
        ),
        other=("optimize.anchor_sigmas=0.3",),
    ),
    "memory": Case(
        lambda given: [
            "memory", str(given / "room"), _words(given), "train.steps=3", "train.warmup=1", "memory.channels=4",
            "pictures=1", "train.checkpoint_every=0", "seeds.voxel=0.1",
        ],
        other=("train.seed=1",),
    ),
    "localize": Case(
        _of_features("localize", "query=cube", "pictures=1", "report=true"), other=("localize.mode=raw",)
    ),
    "select": Case(_of_features("select", "query=cube"), other=("write=[objects]",)),
    "views": Case(_of_features("views", "query=cube", "grid=[3,4]", *VIEWS), other=("choose.method=uniform",)),
    "ask": Case(
        _of_features("ask", f"question={QUESTION}", *VIEWS),
        server=True,
        packages=("openai",),
        other=("vlm.max_tokens=9",),
    ),
    "ask of a file": Case(
        _of_features("ask", "questions=GIVEN/questions.jsonl", *VIEWS),
        server=True,
        packages=("openai",),
        other=("vlm.max_tokens=9",),
    ),
    "ask of a set": Case(
        lambda given: [
            "ask", *(str(given / "asked" / name) for name in ROOMS), f"questions={given / 'ScanQA_v1.0_val.json'}",
            *VIEWS,
        ],
        server=True,
        packages=("openai",),
        other=("vlm.max_tokens=9",),
    ),
    "export of a memory": Case(
        lambda given: ["export", f"memory={given / 'remembered'}"], out="out.onnx", packages=("onnx", "onnxscript")
    ),
    "pack": Case(_of_features("pack"), other=("form=npz",)),
    "pack as npz": Case(_of_features("pack", "form=npz")),
    "pack as ply": Case(_of_features("pack", "form=ply")),
    "evaluate": Case(
        lambda given: [
            "evaluate", str(given / "room"), _words(given), "protocol.min_views=1", "protocol.min_pixels=1",
            "seeds.voxel=0.1",
        ],
        other=("fusion.views=2",),
    ),
    "evaluate instances": Case(
        lambda given: ["evaluate", str(given / "room"), _words(given), "protocol=instances", "seeds.voxel=0.1"]
    ),
    "score": Case(
        lambda given: [
            "score", "recognition", f"predictions={given / 'named' / 'predictions.json'}",
            f"truth={given / 'named' / 'truth.json'}",
        ]
    ),
    "questions": Case(
        _of_room("questions", "min_pixels=10", "per_kind=2", "objects=2", "per_object=1"), other=("seed=1",)
    ),
    "tune": Case(
        lambda given: [
            "tune", str(given / "ScanQA_v1.0_train.json"), f"model={given / 'model'}",
            f"features={given / 'tuned'}", *VIEWS, "image_side=64", "lora.rank=4",
            "train.steps=2", "train.accumulate=1", "train.warmup=1", "train.log_every=1", "train.checkpoint_every=0",
        ],
        beside=("out.prepared",),
        packages=("peft", "transformers"),
    ),
    "tradeoff": Case(
        lambda given: [
            "tradeoff", str(given / "room"), _words(given), "sweep.knobs=views", "sweep.values=views:2",
            "sweep.rounds=1", "seeds.voxel=0.15",
        ],
        other=("data.max_views=2",),
    ),
    "view": Case(_of_features("view", "photographs=1"), out="out.html", other=("max_gaussians=50",)),
    "inspect": Case(_of_room("inspect")),
    "repair": Case(lambda given: ["repair", str(given / "bad.ply")], out="out.ply"),
    "demo": Case(
        lambda given: ["demo", "views=4", "width=80", "objects=2", "seeds.voxel=0.1"], other=("seed=1",)
    ),
}  # fmt: skip
"""By name; GIVEN stands for the folder of inputs."""
EXHAUSTIVE: dict[str, Case] = {
    "export": Case(
        lambda given: ["export", f"weights={given / 'trained'}", "sizes=1,50"],
        out="out.onnx",
        packages=("onnx", "onnxscript"),
        other=("precision=int8_weights",),
    )
}
"""Commands that take too long for a test."""


def words_of(case: Case, given: Path) -> list[str]:
    return [word.replace("GIVEN", str(given)) for word in case.words(given)] + ["quiet=true"]


def _run(*words: str) -> None:
    from gsencoder.app import main as cli

    if cli.main([*words, "quiet=true"]) != 0:
        raise RuntimeError(f"{words[0]}: the inputs cannot be made")


def _room(given: Path) -> None:
    import shutil

    from named_rooms import write_words

    from gsencoder.data.synthetic import make_room, write_room

    room = make_room(0, objects=2, views=3, width=64, height=48, spacing=0.15)
    write_room(room, given / "room")
    for name in ("a", "b"):
        shutil.copytree(given / "room", given / "rooms" / name)
    write_words(given / "words.safetensors", room)


def _features(given: Path) -> None:
    from asked_rooms import save_room

    save_room(given / "features")
    lines = [json.dumps({"id": str(number), "question": text}) for number, text in enumerate((QUESTION, "A crate?"))]
    (given / "questions.jsonl").write_text("".join(line + "\n" for line in lines))


def _trained(given: Path) -> None:
    _run("train", str(given / "room"), _words(given), "tensorboard=false", *TRAIN, f"out={given / 'trained'}")


def _remembered(given: Path) -> None:
    _run(*CASES["memory"].words(given), f"out={given / 'remembered'}")


def _named(given: Path) -> None:
    arguments = ("protocol=recognition", "seeds.voxel=0.1", f"out={given / 'named'}")
    _run("evaluate", str(given / "room"), _words(given), *arguments)


def _model(given: Path) -> None:
    from asked_rooms import save_room
    from tiny_vlm import save_tiny_vlm

    save_tiny_vlm(given / "model")
    (given / "tuned").mkdir()
    save_room(given / "tuned" / "room_a")
    rows = [
        {"scene_id": "room_a", "question_id": f"train-{number}", "question": text, "answers": [answer]}
        for number, (text, answer) in enumerate([("What color is the crate?", "red"), ("How many crates?", "2")])
    ]
    (given / "ScanQA_v1.0_train.json").write_text(json.dumps(rows))


def _asked(given: Path) -> None:
    from asked_rooms import save_room

    rows = [
        {"scene_id": name, "question_id": f"val-{name}", "question": QUESTION, "answers": ["on the floor"]}
        for name in ROOMS
    ]
    (given / "asked").mkdir()
    for name in ROOMS:
        save_room(given / "asked" / name, scene_name=name)
    (given / "ScanQA_v1.0_val.json").write_text(json.dumps(rows))


def _bad_splat(given: Path) -> None:
    from splat_samples import make_raw, ply_bytes, ply_columns

    columns = ply_columns(make_raw(40))
    columns["opacity"][:3] = float("nan")
    (given / "bad.ply").write_bytes(ply_bytes(columns))


INPUTS: dict[str, Callable[[Path], None]] = {
    "room": _room, "features": _features, "trained": _trained, "remembered": _remembered, "named": _named,
    "model": _model, "asked": _asked, "bad.ply": _bad_splat,
}  # fmt: skip
NEEDED = {"encode": ("trained",), "export": ("trained",), "export of a memory": ("remembered",), "score": ("named",)}
NEEDED |= {"tune": ("model",), "ask of a set": ("asked",), "repair": ("bad.ply",)}


def prepare(given: Path, name: str) -> None:
    """Makes the inputs of a case that are not there."""
    for each in ("room", "features", *NEEDED.get(name, ())):
        if not (given / each).exists():
            INPUTS[each](given)
