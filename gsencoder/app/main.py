"""The command line: `gsencoder COMMAND [PATH…] [key=value …]`.

Exit codes: 0 success; 1 a bug (with its traceback); 2 wrong input (with a message of one line); 130 interrupted; 143
terminated. Warnings and errors go to standard error, one line each; results go to standard output.
"""

import errno
import faulthandler
import importlib
import os
import re
import signal
import sys
import textwrap
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import gsencoder
from gsencoder.app.options import CommonConfig, command_help, near, settings, without_value
from gsencoder.core.errors import InputError, clipped, one_line, printable
from gsencoder.core.process import Stopped, refuse_several, stop_of, stopping_signals


@dataclass(frozen=True, slots=True)
class Command:
    """A command: the module `gsencoder.app.commands.NAME`, its settings class, its purpose, and whether several
    processes of one launcher (torchrun, SLURM) can run it together."""

    name: str
    config: str
    help: str
    several: bool = False

    def load(self) -> tuple[type[CommonConfig], Callable[[Any, Any], None]]:
        """The settings class and `run(config, run)`."""
        module = importlib.import_module(f"gsencoder.app.commands.{self.name}")
        return getattr(module, self.config), module.run


_LISTED = (
    Command("demo", "DemoConfig", "run the whole pipeline on a built-in room, offline, and write a report"),
    Command(
        "reconstruct", "ReconstructCommandConfig", "make a splat from photographs, with or without poses", several=True
    ),
    Command("fuse", "FuseCommandConfig", "lift a teacher's feature maps onto the Gaussians of a scene", several=True),
    Command(
        "memory",
        "MemoryCommandConfig",
        "remember the features of several teachers in a few channels a Gaussian, and a bank",
        several=True,
    ),
    Command("train", "TrainCommandConfig", "distil a teacher into an encoder of splats", several=True),
    Command("encode", "EncodeCommandConfig", "compute features of a splat with an encoder, in one pass", several=True),
    Command("pack", "PackConfig", "store features in a few bytes a Gaussian, or for other programs"),
    Command("export", "ExportConfig", "export an encoder, which takes raw Gaussians, or a memory as one ONNX file"),
    Command("localize", "LocalizeCommandConfig", "find words in a scene: boxes, scores and pictures"),
    Command(
        "select",
        "SelectCommandConfig",
        "write the Gaussians of words as splats of their own, the scene without them, and labels",
    ),
    Command("views", "ViewsCommandConfig", "choose and render the views that show best what a word stands for"),
    Command(
        "view", "ViewConfig", "look at a scene and its features in a browser, and search it; or write that as one file"
    ),
    Command("ask", "AskCommandConfig", "ask a vision-language model about views of a scene"),
    Command(
        "tune",
        "TuneCommandConfig",
        "train adapters of a vision-language model on questions about scenes and their answers",
        several=True,
    ),
    Command("evaluate", "EvaluateConfig", "score boxes, names, masks and views on labeled scenes", several=True),
    Command(
        "score",
        "ScoreConfig",
        "score files of predictions, of this program or another, against a benchmark's truth",
    ),
    Command("rooms", "RoomsConfig", "make furnished rooms with photographs and labels from libraries of models"),
    Command("tradeoff", "TradeoffConfig", "measure what each knob of a stage costs and gains, alone and together"),
    Command("inspect", "InspectConfig", "show what a scene or a splat file holds, and what is wrong"),
    Command("repair", "RepairConfig", "mend a splat file, or the poses of a scene, and report the changes"),
)
COMMANDS = {command.name: command for command in _LISTED}


FLAGS = {
    "--help": "show this help (-h)",
    "--version": "show the version",
    "--cfg": "print the settings that the command would run with, as YAML, and stop",
    "--debug": "show where an error or a warning came from",
    "--multirun": "run every combination of values, key=1,2,3 (-m); run k writes to OUT/k",
}
TOO_LARGE = re.compile(
    "(enough|allocate|out of) memory|cannot fit 'int'|too big|too large to|Maximum allowed|negative dim|overflow",
    re.IGNORECASE,
)
"""Words of the errors of torch, numpy and Python for sizes that cannot be allocated or counted."""
SHORT = {"-h": "--help", "-m": "--multirun"}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command line, by default that of the process, and returns the exit code."""
    began, words = time.perf_counter(), list(sys.argv[1:] if argv is None else argv)
    # How often threads of torch look for one another before they sleep. With the default they take the cores from the
    # thread that they wait for where other programs compute, and steps take five times as long.
    os.environ.setdefault("GOMP_SPINCOUNT", "3000")
    debug = "--debug" in words[: words.index("--") if "--" in words else None]
    if not faulthandler.is_enabled():
        # A mapped file that was cut off, a broken disk or a library may end the process: where is said on the way.
        with suppress(OSError, ValueError, RuntimeError, AttributeError):
            faulthandler.enable()
    for stream in (sys.stdout, sys.stderr):
        # File names may hold bytes that the terminal's encoding cannot show.
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    try:
        with stopping_signals():
            code = _dispatch(words, began)
            sys.stdout.flush()
            return code
    except InputError as error:
        _report("error", error, debug)
        return 2
    except (KeyboardInterrupt, Stopped, SystemError) as error:
        stop = stop_of(error)
        if stop is None:
            raise
        number = stop.number if isinstance(stop, Stopped) else signal.SIGINT
        if isinstance(stop, Stopped):
            _report("stopped", stop, debug, signal.Signals(number).name)
        else:
            _report("interrupted", stop, debug)
        return 128 + number
    except BrokenPipeError:
        _discard_stdout()
        return 1
    except OSError as error:
        line = _fault_of_system(error)
        if line is None:
            raise
        _report("error", error, debug, line)
        if error.filename is None:
            _discard_stdout()
        return 2


def _fault_of_system(error: OSError) -> str | None:
    """The line for a full or broken disk, or a file that has gone or may not be read; None for any other error."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"{error.filename or 'standard output'}: no space left on the device"
    if error.filename is not None and error.strerror is not None:
        # Of a file that is copied, both are named, since either may be to blame.
        names = [
            os.fsdecode(each) if isinstance(each, bytes) else str(each)
            for each in (error.filename, error.filename2)
            if each
        ]
        return f"{' to '.join(names)}: {error.strerror}"
    return f"a file or a device failed: {error.strerror}" if error.errno in (errno.EIO, errno.EROFS) else None


@contextmanager
def _impossible_sizes() -> Iterator[None]:
    """Turns the errors of sizes that no memory holds, and of links to themselves, into one line."""
    try:
        yield
    except (MemoryError, OverflowError, RuntimeError, ValueError) as error:
        text = " ".join(str(error).split())
        if text.startswith("Symlink loop from "):
            raise InputError(f"{text.removeprefix('Symlink loop from ')}: is a link that leads to itself") from error
        if not isinstance(error, MemoryError) and not TOO_LARGE.search(text):
            raise
        raise InputError(
            f"the machine has not enough memory for a size in the settings or the input ({text[:200]}); give smaller "
            "numbers, or less input"
        ) from error


def _report(kind: str, error: BaseException, debug: bool, message: str = "") -> None:
    """Prints an error with its notes; `message` stands for the text of one that is not ours."""
    if debug:
        # It may contain messages of other programs and of servers.
        for line in traceback.format_exc().splitlines():
            print(printable(clipped(line)), file=sys.stderr)
    message = message or str(error)
    print(f"{kind}: {one_line(message)}" if message else kind, file=sys.stderr)
    for note in getattr(error, "__notes__", ()):
        print(f"note: {one_line(note)}", file=sys.stderr)


def _discard_stdout() -> None:
    """Redirects standard output to nowhere: its reader is gone, and the interpreter would fail to flush it at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _split_flags(words: Sequence[str]) -> tuple[set[str], list[str]]:
    flags: set[str] = set()
    rest: list[str] = []
    for index, word in enumerate(words):
        if word == "--":
            return flags, rest + list(words[index:])
        if not word.startswith("-") or word == "-":
            rest.append(word)
        elif SHORT.get(word, word) in FLAGS:
            flags.add(SHORT.get(word, word))
        else:
            flag = without_value(word)
            hint = f"; settings are written {flag.lstrip('-')}" if "=" in word else near(word, FLAGS)
            raise InputError(f"{flag}: no such flag{hint}")
    return flags, rest


def _dispatch(words: Sequence[str], began: float) -> int:
    flags, rest = _split_flags(words)
    if "--version" in flags:
        print(f"gsencoder {gsencoder.__version__}")
        return 0
    if not rest:
        print(_overview())
        return 0
    name, *words = rest
    if name not in COMMANDS:
        bare_name = without_value(name)
        raise InputError(f"{bare_name}: no such command{near(bare_name, COMMANDS)} (gsencoder --help lists them)")
    command = COMMANDS[name]
    cls, _ = command.load()
    if "--help" in flags:
        print(command_help(command.name, command.help, cls, FLAGS))
        return 0
    # It needs Hydra, which takes a while to load.
    from gsencoder.app.compose import compose, run_sweep

    if "--multirun" in flags:
        if "--cfg" in flags:
            raise InputError("--cfg: shows one run; leave out -m")
        return run_sweep(name, cls, words, partial(_run_one, command, debug="--debug" in flags))
    config = compose(name, cls, words)
    if "--cfg" in flags:
        from omegaconf import OmegaConf

        print(printable(OmegaConf.to_yaml(settings(config))), end="")
        return 0
    _run(command, config, "--debug" in flags, began)
    return 0


def _run(command: Command, config: Any, debug: bool, began: float | None = None) -> None:
    """Runs a command; what it took to load it counts from `began`."""
    from gsencoder.app.output import refuse_to_replace_inputs
    from gsencoder.app.run import Run

    _, run_command = command.load()
    check_required(config)
    with _impossible_sizes():
        if not command.several:
            together = ", ".join(each.name for each in COMMANDS.values() if each.several)
            refuse_several(command.name, f"start it once; {together} are the commands that processes run together")
        run = Run(command.name, config, began)
        with run.warning_lines(debug):
            refuse_to_replace_inputs(config.out, run.settings)
            run_command(config, run)


def check_required(config: Any) -> None:
    """Raises an InputError about the first required option that is empty."""
    for item in fields(config):
        if item.metadata.get("required") and getattr(config, item.name) in (None, "", ()):
            name = item.metadata.get("metavar", "PATH") if item.name == "paths" else f"{item.name}="
            raise InputError(f"{name} is missing: {item.metadata['help']}")


def _run_one(command: Command, config: Any, debug: bool) -> str:
    """Runs one of several runs; its error is printed and returned, with those of its scenes."""
    try:
        _run(command, config, debug)
    except InputError as error:
        message = f"{config.out}: {error}"
        _report("error", error, debug, message)
        # Whoever started the run in another process has not seen them.
        return "\n".join((message, *getattr(error, "reasons", ())))
    return ""


def _overview() -> str:
    lines = ["usage: gsencoder COMMAND [PATH…] [key=value …]", "", "commands:"]
    lines += [f"  {command.name:<12}{command.help}" for command in COMMANDS.values()]
    lines += ["", "flags:"]
    lines += [f"  {name:<12}{text}" for name, text in FLAGS.items()]
    lines += ["", *textwrap.wrap("gsencoder COMMAND --help lists the settings of a command.", 100)]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
