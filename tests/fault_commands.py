"""Every command that writes, as short as it runs: what faults are put into, and the inputs that they all read."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

TRAIN = """
train.steps=3 train.warmup=1 train.log_every=1 train.checkpoint_every=0 train.validate_every=0 sampling.gaussians=600
sampling.smallest=200 model.voxel=0.2 model.transformer.encoder_depths=[1,1] seeds.voxel=0.1
model.transformer.encoder_channels=[16,16] model.transformer.decoder_depths=[1] model.transformer.patch=32
model.transformer.decoder_channels=[16] model.transformer.head_channels=16
"""
WORDS = "teacher.words=GIVEN/words.safetensors"
FUSED = f"GIVEN/room {WORDS} seeds.voxel=0.1"
VIEWS = "choose.source=frames choose.candidates=4 choose.count=2"
QUESTION = "Where is the cube?"
ROOMS = ("room_a", "room_b")


@dataclass(frozen=True)
class Case:
    """A command line without out=, and what is true of it."""

    words: str
    """GIVEN stands for the folder of inputs, QUESTION for the question."""
    out: str = "out"
    beside: tuple[str, ...] = ()
    """What else may stay beside out= after a run that ended, and what of an unfinished one is read again."""
    server: bool = False
    """Whether it asks a server of chat."""
    several: bool = False
    """Whether it is of several scenes, each with a folder in out=."""
    other: tuple[str, ...] = ()
    """Settings with which it writes other results, as a second run of it in the same folder."""


def _asking(words: str) -> Case:
    return Case(f"ask {words} {VIEWS}", server=True, other=("vlm.max_tokens=9",))


CASES: dict[str, Case] = {
    "fuse": Case(f"fuse {FUSED}", other=("fusion.views=2",)),
    "fuse with a report": Case(f"fuse {FUSED} report=true"),
    "fuse several": Case(f"fuse GIVEN/rooms {WORDS} seeds.voxel=0.1", several=True),
    "encode": Case("encode GIVEN/room weights=GIVEN/trained seeds.voxel=0.1", other=("data.max_views=2",)),
    "train": Case(
        f"train GIVEN/room {WORDS} tensorboard=true {TRAIN}", beside=("out.prepared",), other=("train.seed=1",)
    ),
    "reconstruct": Case(
        "reconstruct GIVEN/room optimize.steps=3 holdout=3 seeds.voxel=0.15 optimize.sh_degree=0 checkpoint_every=0",
        other=("optimize.anchor_sigmas=0.3",),
    ),
    "memory": Case(
        f"memory {FUSED} train.steps=3 train.warmup=1 memory.channels=4 pictures=1 train.checkpoint_every=0",
        other=("train.seed=1",),
    ),
    "localize": Case("localize GIVEN/features query=cube pictures=1 report=true", other=("localize.mode=raw",)),
    "select": Case("select GIVEN/features query=cube", other=("write=[objects]",)),
    "views": Case(f"views GIVEN/features query=cube grid=[3,4] {VIEWS}", other=("choose.method=uniform",)),
    "ask": _asking("GIVEN/features question=QUESTION"),
    "ask of a file": _asking("GIVEN/features questions=GIVEN/questions.jsonl"),
    "ask of a set": _asking("GIVEN/asked/room_a GIVEN/asked/room_b questions=GIVEN/ScanQA_v1.0_val.json"),
    "export of a memory": Case("export memory=GIVEN/remembered", out="out.onnx"),
    "pack": Case("pack GIVEN/features", other=("form=npz",)),
    "pack as npz": Case("pack GIVEN/features form=npz"),
    "pack as ply": Case("pack GIVEN/features form=ply"),
    "evaluate": Case(f"evaluate {FUSED} protocol.min_views=1 protocol.min_pixels=1", other=("fusion.views=2",)),
    "evaluate instances": Case(f"evaluate {FUSED} protocol=instances"),
    "rooms": Case("rooms GIVEN/library.sh3f types=[bathroom] walk.views=3 walk.width=32", several=True),
    "score": Case("score recognition predictions=GIVEN/named/predictions.json truth=GIVEN/named/truth.json"),
    "tune": Case(
        f"tune GIVEN/ScanQA_v1.0_train.json model=GIVEN/model features=GIVEN/tuned {VIEWS} image_side=64 lora.rank=4 "
        "train.steps=2 train.accumulate=1 train.warmup=1 train.log_every=1 train.checkpoint_every=0",
        beside=("out.prepared",),
    ),
    "tradeoff": Case(
        f"tradeoff GIVEN/room {WORDS} sweep.knobs=views sweep.values=views:2 sweep.rounds=1 seeds.voxel=0.15",
        other=("data.max_views=2",),
    ),
    "view": Case("view GIVEN/features photographs=1", out="out.html", other=("max_gaussians=50",)),
    "inspect": Case("inspect GIVEN/room"),
    "repair": Case("repair GIVEN/bad.ply", out="out.ply"),
    "demo": Case("demo views=4 width=80 objects=2 seeds.voxel=0.1", other=("seed=1",)),
}
EXHAUSTIVE = {"export": Case("export weights=GIVEN/trained sizes=1,50", "out.onnx", other=("precision=int8_weights",))}
"""Commands that take too long for a test."""


def words_of(words: str, given: Path) -> list[str]:
    return [word.replace("GIVEN", str(given)).replace("QUESTION", QUESTION) for word in [*words.split(), "quiet=true"]]


def _run(given: Path, words: str, out: str) -> None:
    from gsencoder.app import main as cli

    if cli.main([*words_of(words, given), f"out={given / out}"]) != 0:
        raise RuntimeError(f"{words}: the inputs cannot be made")


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


def _library(given: Path) -> None:
    from furniture import write_library

    write_library(given / "library.sh3f")


INPUTS: dict[str, Callable[[Path], None]] = {
    "room": _room, "features": _features, "model": _model, "asked": _asked, "bad.ply": _bad_splat,
    "library.sh3f": _library,
    "trained": lambda given: _run(given, f"train GIVEN/room {WORDS} tensorboard=false {TRAIN}", "trained"),
    "remembered": lambda given: _run(given, CASES["memory"].words, "remembered"),
    "named": lambda given: _run(given, f"evaluate {FUSED} protocol=recognition", "named"),
}  # fmt: skip
NEEDED = {"encode": ("trained",), "export": ("trained",), "export of a memory": ("remembered",), "score": ("named",)}
NEEDED |= {"tune": ("model",), "ask of a set": ("asked",), "repair": ("bad.ply",), "rooms": ("library.sh3f",)}


def prepare(given: Path, name: str) -> None:
    """Makes the inputs of a case that are not there."""
    for each in ("room", "features", *NEEDED.get(name, ())):
        if not (given / each).exists():
            INPUTS[each](given)
