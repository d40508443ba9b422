"""The PTB tokenizer and METEOR, which exist in Java only: run where Java and the package pycocoevalcap are installed.

The package brings Stanford's tokenizer (CoreNLP 3.4.1) and METEOR 1.5 as archives, which are run with the options that
its own code gives them; none of its Python code is imported. METEOR (Denkowski and Lavie 2014) of a corpus comes from
the counts of all samples, and is no mean of theirs.
"""

import os
import re
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError
from gsencoder.evaluate.scores.ngrams import PUNCTUATION

PACKAGE = "pycocoevalcap"
PTB_TOKENS = "PTB tokens"
"""Name of what `ptb_tokens` gives."""
TOKENIZER, METEOR = "tokenizer/stanford-corenlp-3.4.1.jar", "meteor/meteor-1.5.jar"
SECONDS = 1800
"""Longest time that Java may take for all sentences."""
# The system's encoding decides otherwise, so that é is two characters under one locale and one under another.
ENCODING = ("-Dfile.encoding=UTF-8", "-Dstdout.encoding=UTF-8", "-Duser.language=en")
_BREAKS = re.compile(r"[\r\n\v\f\x1c-\x1e\x85\u2028\u2029]+")


@dataclass(frozen=True, slots=True, kw_only=True)
class JavaTools:
    """Where Java and the archives are.

    Attributes:
        java: the program.
        folder: of the package.
    """

    java: str
    folder: Path


def find_java_tools() -> JavaTools | str:
    """Java and the archives, or the reason why they cannot be run, as a clause."""
    java = shutil.which("java")
    if java is None:
        return "no Java: the program java is not in the path"
    spec = find_spec(PACKAGE)
    folder = next(iter(spec.submodule_search_locations or ()), None) if spec else None
    if folder is None:
        return f"the package {PACKAGE} is not installed (pip install {PACKAGE}==1.2)"
    absent = next((name for name in (TOKENIZER, METEOR) if not (Path(folder) / name).is_file()), None)
    return f"{folder} lacks {absent}" if absent else JavaTools(java=java, folder=Path(folder))


def ptb_tokens(texts: Sequence[str], tools: JavaTools) -> list[str]:
    """Tokens of the Penn Treebank, lower case, without punctuation, as pycocoevalcap's PTBTokenizer gives them.

    Line breaks inside a text count as blanks. The package replaces \\n alone and reads other breaks as ends of a text,
    after which all later ones belong to the wrong samples.

    Args:
        texts: of all samples.
        tools: of `find_java_tools`.

    Returns:
        The tokens of each text with one blank between them.

    Raises:
        InputError: Java fails, or takes too long.
    """
    lines = [" ".join(_BREAKS.sub(" ", text).split()) for text in texts]
    rows = [row for row, line in enumerate(lines) if line]
    tokens = [""] * len(texts)
    if not rows:
        return tokens
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "sentences.txt"
        file.write_bytes("\n".join(lines[row] for row in rows).encode("utf-8", "replace"))
        command = [tools.java, *ENCODING, "-cp", str(tools.folder / TOKENIZER)]
        command += ["edu.stanford.nlp.process.PTBTokenizer", "-preserveLines", "-lowerCase", str(file)]
        output = _run(command, "the PTB tokenizer")
    cut = output.removesuffix("\n").split("\n")
    if len(cut) != len(rows):
        raise InputError(f"the PTB tokenizer gave {len(cut):,} lines for {len(rows):,} texts; expected as many")
    for row, line in zip(rows, cut, strict=True):
        tokens[row] = " ".join(token for token in line.rstrip().split(" ") if token not in PUNCTUATION)
    return tokens


def meteor(
    hypotheses: Sequence[str], references: Sequence[Sequence[str]], tools: JavaTools
) -> tuple[float, Float64[np.ndarray, "N"]]:
    """METEOR 1.5 for English of a corpus, and of each sample.

    Args:
        hypotheses: tokens of each sample with blanks between them.
        references: one or more such sentences for each sample.
        tools: of `find_java_tools`.

    Returns:
        Scores in [0, 1]: of the corpus, NaN without samples, and of each sample.

    Raises:
        InputError: Java fails, or takes too long.
    """
    if not hypotheses:
        return float("nan"), np.zeros(0)
    lines = [
        "SCORE ||| " + " ||| ".join([*map(_field, sentences), _field(hypothesis).replace("  ", " ")])
        for hypothesis, sentences in zip(hypotheses, references, strict=True)
    ]
    command = [tools.java, *ENCODING, "-Xmx2G", "-jar", str(tools.folder / METEOR)]
    command += ["-", "-", "-stdio", "-l", "en", "-norm"]
    with _Conversation(command, "METEOR") as java:
        counts = [java.answers(line)[0] for line in lines]
        scores = java.answers(" ||| ".join(["EVAL", *counts]), len(lines) + 1)
    try:
        values = np.array(scores, np.float64)
    except ValueError as error:
        raise InputError(f"METEOR gave something else than scores ({' '.join(str(error).split())[:80]})") from error
    return float(values[-1]), values[:-1]


def _field(sentence: str) -> str:
    """A sentence as METEOR's protocol takes one: no line breaks, and not what separates two sentences."""
    return _BREAKS.sub(" ", sentence).replace("|||", "")


class _Conversation:
    """A program that answers lines with lines; it is ended with the block, or after `SECONDS`."""

    def __init__(self, command: Sequence[str], subject: str) -> None:
        self.subject = subject
        self.errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the block
        pipe = subprocess.PIPE
        try:
            self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=self.errors, env=_environment())
        except OSError as error:
            self.errors.close()
            raise InputError(f"{subject}: Java cannot be started: {error.strerror or error}") from error
        self.timer = threading.Timer(SECONDS, self.process.kill)
        self.timer.daemon = True
        self.timer.start()

    def __enter__(self) -> "_Conversation":
        return self

    def __exit__(self, *_: object) -> None:
        self.timer.cancel()
        self.process.kill()
        self.process.communicate()
        self.errors.close()

    def answers(self, line: str, count: int = 1) -> list[str]:
        """The next lines that the program writes after it got one."""
        stdin, stdout = self.process.stdin, self.process.stdout
        assert stdin is not None
        assert stdout is not None
        try:
            stdin.write(line.encode("utf-8", "replace") + b"\n")
            stdin.flush()
        except OSError:
            raise self._failure() from None
        lines = [stdout.readline() for _ in range(count)]
        if not lines[-1].endswith(b"\n"):
            raise self._failure()
        return [each.decode("utf-8", "replace").strip() for each in lines]

    def _failure(self) -> InputError:
        self.errors.seek(0)
        return InputError(
            f"{self.subject}: Java ended early, or took more than {SECONDS:,} s: {_end(self.errors.read())}"
        )


def _run(command: Sequence[str], subject: str) -> str:
    """What a program writes."""
    try:
        process = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=SECONDS, env=_environment(), check=False
        )
    except subprocess.TimeoutExpired:
        raise InputError(
            f"{subject}: Java did not end within {SECONDS:,} seconds; score fewer samples at once"
        ) from None
    except OSError as error:
        raise InputError(f"{subject}: Java cannot be started: {error.strerror or error}") from error
    if process.returncode:
        raise InputError(f"{subject}: Java ended with code {process.returncode}: {_end(process.stderr)}")
    return process.stdout.decode("utf-8", "replace")


def _environment() -> dict[str, str]:
    """Without options for Java, which say what they do in the output."""
    return {name: value for name, value in os.environ.items() if name not in ("JAVA_TOOL_OPTIONS", "_JAVA_OPTIONS")}


def _end(message: bytes) -> str:
    return " ".join(message.decode("utf-8", "replace").split())[-200:] or "it said nothing"
