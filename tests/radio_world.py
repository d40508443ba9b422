"""Rooms, a small RADIO and its text tower, and the words of command lines that name them."""

from pathlib import Path

from radios import small_joint_model, small_radio

from gsencoder.app import main as cli
from gsencoder.data.synthetic import make_room, write_room

SEEDS = ("seeds.voxel=0.12",)
QUICK = (
    "quiet=true", "tensorboard=false", "model.transformer.encoder_depths=[1]", "model.transformer.patch=64",
    "model.transformer.encoder_channels=[32]", "model.transformer.decoder_depths=[]", "train.steps=3",
    "model.transformer.decoder_channels=[]", "train.warmup=1", "train.log_every=1", "sampling.views=1",
    "sampling.gaussians=400", "sampling.smallest=100",
)  # fmt: skip
"""With one level: heads follow the encoder, and a graph of two takes twice as long to export."""


class World:
    """The folders of the tests, and the words of command lines that name them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.radio = small_radio(folder / "radio")
        self.siglip = small_joint_model(folder / "siglip")
        for number in range(2):
            write_room(make_room(number, objects=3, views=3, width=96, height=72), folder / f"room_{number}")

    @property
    def teacher(self) -> tuple[str, ...]:
        return ("teacher=radio", f"teacher.model={self.radio}", "teacher.size=48", "teacher.device=cpu")

    @property
    def text(self) -> tuple[str, ...]:
        return ("text=transformers", f"text.model={self.siglip}")

    def room(self, number: int) -> str:
        return str(self.folder / f"room_{number}")


def run(*words: str) -> None:
    assert cli.main([*words, "quiet=true"]) == 0
