"""The commands, one small file each. Nothing is imported before it is asked for, so that `--help` is quick."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gsencoder.app.settings.config import CommonConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """One entry of the command line.

    Attributes:
        name: what the user types; `gsencoder.app.commands.NAME` is its module.
        config: the name of the settings class in that module.
        help: what it does, in one line.
    """

    name: str
    config: str
    help: str

    def load(self) -> tuple[type[CommonConfig], Callable[[Any, Any], None]]:
        """The settings class and `run(config, summary)`."""
        module = importlib.import_module(f"gsencoder.app.commands.{self.name}")
        return getattr(module, self.config), module.run


COMMANDS = {
    command.name: command
    for command in (
        Command(
            name="demo", config="DemoConfig", help="the whole pipeline on a built-in scene, offline, in one report"
        ),
        Command(name="reconstruct", config="ReconstructCommandConfig", help="photographs to Gaussians, posed or not"),
        Command(name="fuse", config="FuseCommandConfig", help="per-Gaussian features from a teacher's maps"),
        Command(name="train", config="TrainCommandConfig", help="distil a teacher into an encoder of splats"),
        Command(name="encode", config="EncodeCommandConfig", help="per-Gaussian features of a splat in one pass"),
        Command(name="pack", config="PackConfig", help="features in a few bytes a Gaussian, or for other programs"),
        Command(name="export", config="ExportConfig", help="an encoder as one ONNX file that takes raw Gaussians"),
        Command(name="localize", config="LocalizeCommandConfig", help="boxes, scores and pictures for words"),
        Command(name="views", config="ViewsCommandConfig", help="the views that show best what a word found"),
        Command(name="ask", config="AskCommandConfig", help="a vision-language model's answer from such views"),
        Command(name="evaluate", config="EvaluateConfig", help="a paper's metric on labeled scenes"),
        Command(name="tradeoff", config="TradeoffConfig", help="what each accuracy knob costs and gives, measured"),
        Command(name="inspect", config="InspectConfig", help="what is in a splat file, and what is wrong with it"),
        Command(name="repair", config="RepairConfig", help="mend a splat file, and say what was changed"),
    )
}
