"""Java's tokenizer and METEOR: the protocol against stand-ins, and the real ones where they are installed."""

import stat
import sys
from pathlib import Path

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.evaluate.benchmarks import text_metrics as java_metrics
from gsencoder.evaluate.benchmarks.text_metrics import JavaTools, find_java_tools, meteor, ptb_tokens, python_tokens

ECHO = 'import sys; print(open(sys.argv[-1], encoding="utf-8").read().lower())'


def stand_in(folder: Path, program: str) -> JavaTools:
    """A program in Java's place."""
    java = folder / "java"
    java.write_text(f"#!{sys.executable}\n{program}")
    java.chmod(java.stat().st_mode | stat.S_IXUSR)
    return JavaTools(java=str(java), folder=folder)


@pytest.fixture
def real() -> JavaTools:
    tools = find_java_tools()
    if isinstance(tools, str):
        pytest.skip(tools)
    return tools


def test_texts_keep_their_places_and_their_breaks_become_blanks(tmp_path: Path) -> None:
    texts = ["A chair .", "", "two\nlines\r\nof\u2028it", " \n ", "É -lrb- ?"]
    tokens = ptb_tokens(texts, stand_in(tmp_path, ECHO))
    assert tokens == ["a chair", "", "two lines of it", "", "é -lrb-"]
    assert ptb_tokens(["", " "], JavaTools(java="/nowhere", folder=tmp_path)) == ["", ""]


def test_what_java_says_when_it_fails_is_told(tmp_path: Path) -> None:
    for program, problem in (
        ("import sys; sys.exit('no heap')", "no heap"),
        ("print('x')", "PTB tokenizer gave 1 lines"),
    ):
        with pytest.raises(InputError, match=problem):
            ptb_tokens(["a", "b"], stand_in(tmp_path, program))
    with pytest.raises(InputError, match="Java ended with code 1: no memory"):
        meteor(["a"], [["a"]], stand_in(tmp_path, "import sys; sys.exit('no memory')"))
    with pytest.raises(InputError, match="METEOR gave 1 counts and 1 scores for 1 samples"):
        meteor(["a"], [["a"]], stand_in(tmp_path, "print('x')"))
    with pytest.raises(InputError, match="Java cannot be run"):
        meteor(["a"], [["a"]], JavaTools(java="/nowhere/java", folder=tmp_path))


def test_the_reason_for_going_without_java_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(java_metrics.shutil, "which", lambda name: None)
    assert "no Java" in str(find_java_tools())
    monkeypatch.setattr(java_metrics.shutil, "which", lambda name: "/usr/bin/java")
    monkeypatch.setattr(java_metrics, "find_spec", lambda name: None)
    assert "pycocoevalcap is not installed" in str(find_java_tools())
    monkeypatch.undo()
    monkeypatch.setattr(java_metrics.shutil, "which", lambda name: "/usr/bin/java")
    monkeypatch.setattr(java_metrics, "PACKAGE", "json")
    assert "lacks tokenizer/stanford-corenlp" in str(find_java_tools())


LISTENER = """
import sys
heard = open({log!r}, "a", encoding="utf-8")
print(*sys.argv[1:], sep="\\n", file=heard, flush=True)
if "-stdio" not in sys.argv:
    sys.stdout.write(open(sys.argv[-1], encoding="utf-8").read())
    sys.exit()
for line in sys.stdin:
    heard.write(line); heard.flush()
    kind, *fields = line.rstrip("\\n").split(" ||| ")
    for row in range(len(fields) + 1 if kind == "EVAL" else 1):
        print(0.125 * row if kind == "EVAL" else f"count {{fields[-1]}}", flush=True)
"""


def test_meteor_gets_references_before_the_hypothesis_and_gives_each_score_and_then_that_of_all(tmp_path: Path) -> None:
    log = tmp_path / "heard.txt"
    tools = stand_in(tmp_path, LISTENER.format(log=str(log)))
    whole = meteor(["a  b", "c ||| d\ne"], [["r1", "r2"], ["r3"]], tools)
    lines = log.read_text().splitlines()
    assert [line for line in lines if "|||" in line] == [
        "SCORE ||| r1 ||| r2 ||| a b",
        "SCORE ||| r3 ||| c d e",
        "EVAL ||| count a b ||| count c d e",
    ]
    assert whole == 0.25
    assert np.isnan(meteor([], [], tools))
    options = [*java_metrics.ENCODING, *("-Xmx2G", "-jar", "-", "-", "-stdio", "-l", "-norm")]
    assert [word for word in lines if word.startswith("-")] == 2 * options


def test_the_tokenizer_gets_texts_that_are_none_and_tokens_lose_punctuation(tmp_path: Path) -> None:
    log = tmp_path / "heard.txt"
    tools = stand_in(tmp_path, LISTENER.format(log=str(log)))
    assert ptb_tokens(["", "a , b .", "  ", "c\x85d ''"], tools) == ["", "a b", "", "c d"]
    assert {"-preserveLines", "-lowerCase", "edu.stanford.nlp.process.PTBTokenizer"} <= set(
        log.read_text().splitlines()
    )


def test_options_for_java_of_the_environment_do_not_reach_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = "import os\nprint(os.environ.get('JAVA_TOOL_OPTIONS'), os.environ['KEPT'])\n"
    for name in ("JAVA_TOOL_OPTIONS", "_JAVA_OPTIONS", "KEPT"):
        monkeypatch.setenv(name, "x")
    assert ptb_tokens(["a"], stand_in(tmp_path, program)) == ["None x"]


@pytest.mark.slow
def test_the_treebank_tokenizer_agrees_with_ours_on_plain_texts(real: JavaTools) -> None:
    texts = ["The chair's (brown) leg isn't here.", "twenty-three 3.5 and 1/2", "", "café, o'clock?"]
    assert ptb_tokens(texts, real) == [python_tokens(text) for text in texts]


@pytest.mark.slow
def test_meteor_of_equal_sentences_is_near_one_and_of_none_zero(real: JavaTools) -> None:
    assert meteor(["a brown chair near the door"], [["a brown chair near the door"]], real) == pytest.approx(1.0)
    assert meteor([""], [["a table"]], real) == 0
