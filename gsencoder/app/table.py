"""The table of commands. A command's module is imported when it is used, so that `--help` is quick."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gsencoder.app.options import CommonConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """A command of the command line.

    Attributes:
        name: as the user types it; `gsencoder.app.commands.NAME` is its module.
        config: the name of the settings class in that module.
        help: its purpose, one line.
        several: whether several processes of one launcher (torchrun, SLURM) can run it together.
    """

    name: str
    config: str
    help: str
    several: bool = False

    def load(self) -> tuple[type[CommonConfig], Callable[[Any, Any], None]]:
        """The settings class and `run(config, summary)`."""
        module = importlib.import_module(f"gsencoder.app.commands.{self.name}")
        return getattr(module, self.config), module.run


COMMANDS = {
    command.name: command
    for command in (
        Command(
            name="demo",
            config="DemoConfig",
            help="run the whole pipeline on a built-in room, offline, and write a report",
        ),
        Command(
            name="reconstruct",
            config="ReconstructCommandConfig",
            help="make a splat from photographs, with or without poses",
            several=True,
        ),
        Command(
            name="fuse",
            config="FuseCommandConfig",
            help="lift a teacher's feature maps onto the Gaussians of a scene",
            several=True,
        ),
        Command(
            name="memory",
            config="MemoryCommandConfig",
            help="remember the features of several teachers in a few channels a Gaussian, and a bank",
            several=True,
        ),
        Command(
            name="train", config="TrainCommandConfig", help="distil a teacher into an encoder of splats", several=True
        ),
        Command(
            name="encode",
            config="EncodeCommandConfig",
            help="compute features of a splat with an encoder, in one pass",
            several=True,
        ),
        Command(
            name="pack", config="PackConfig", help="store features in a few bytes a Gaussian, or for other programs"
        ),
        Command(
            name="export",
            config="ExportConfig",
            help="export an encoder, which takes raw Gaussians, or a memory as one ONNX file",
        ),
        Command(
            name="localize", config="LocalizeCommandConfig", help="find words in a scene: boxes, scores and pictures"
        ),
        Command(
            name="select",
            config="SelectCommandConfig",
            help="write the Gaussians of words as splats of their own, the scene without them, and labels",
        ),
        Command(
            name="views",
            config="ViewsCommandConfig",
            help="choose and render the views that show best what a word stands for",
        ),
        Command(
            name="view",
            config="ViewConfig",
            help="look at a scene and its features in a browser, and search it; or write that as one file",
        ),
        Command(name="ask", config="AskCommandConfig", help="ask a vision-language model about views of a scene"),
        Command(
            name="questions",
            config="QuestionsCommandConfig",
            help="make questions and expressions with their answers from the labels of scenes",
        ),
        Command(
            name="tune",
            config="TuneCommandConfig",
            help="train adapters of a vision-language model on questions about scenes and their answers",
            several=True,
        ),
        Command(
            name="evaluate",
            config="EvaluateConfig",
            help="score boxes, names, masks and views on labeled scenes",
            several=True,
        ),
        Command(
            name="score",
            config="ScoreConfig",
            help="score files of predictions, of this program or another, against a benchmark's truth",
        ),
        Command(
            name="tradeoff",
            config="TradeoffConfig",
            help="measure what each knob of a stage costs and gains, alone and together",
        ),
        Command(
            name="inspect", config="InspectConfig", help="show what a scene or a splat file holds, and what is wrong"
        ),
        Command(
            name="repair",
            config="RepairConfig",
            help="mend a splat file, or the poses of a scene, and report the changes",
        ),
    )
}
