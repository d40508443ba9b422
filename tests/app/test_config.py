"""Settings: numbers are checked, text arrives as it was typed, choices select dataclasses, errors name the option."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from gsencoder.app import main as cli
from gsencoder.app.compose import compose, from_dict, join_list, split_list
from gsencoder.app.main import COMMANDS, check_required
from gsencoder.app.options import HIDDEN, CommonConfig, options_of, settings, union_members
from gsencoder.core.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelsConfig:
    name: Literal["labels"] = "labels"
    table: Path | None = field(default=None, metadata={"help": "names and embeddings"})


@dataclass(frozen=True, slots=True, kw_only=True)
class OnnxConfig:
    name: Literal["onnx"] = "onnx"
    weights: str = field(default="", metadata={"help": "an ONNX file"})
    top_k: int = field(default=5, metadata={"help": "posteriors kept"})


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionConfig:
    voxel: float = field(default=0.02, metadata={"help": "grid in metres"})
    lift: Literal["center", "blend"] = field(default="blend", metadata={"help": "which lift"})
    tau: float | None = field(default=None, metadata={"help": "occlusion tolerance"})
    window: tuple[float, float] = field(default=(0.0, 1.0), metadata={"help": "depth range"})
    ranks: tuple[int, ...] = field(default=(8, 16), metadata={"help": "ranks"})
    against: tuple[Literal["depth", "render"], ...] = field(default=("depth",), metadata={"help": "tests"})

    def __post_init__(self) -> None:
        if self.voxel <= 0:
            raise InputError(f"voxel: expected a positive size, got {self.voxel}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ToyConfig(CommonConfig):
    paths: tuple[str, ...] = field(default=(), metadata={"help": "scenes", "metavar": "SCENE", "required": True})
    query: tuple[str, ...] = field(default=(), metadata={"help": "words"})
    question: str = field(default="", metadata={"help": "a question"})
    device: str | None = field(default=None, metadata={"help": "where to run"})
    seed: int = field(default=0, metadata={"help": "seed"})
    fusion: FusionConfig = field(default_factory=FusionConfig)
    teacher: LabelsConfig | OnnxConfig = field(default_factory=LabelsConfig)


def toy(conf: Path, *words: str) -> ToyConfig:
    return compose("toy", ToyConfig, words, conf)


def test_numbers_lists_and_choices_are_parsed(conf: Path) -> None:
    words = ("seed=3", "voxel=1", "fusion.tau=1e-3", "lift=center", "ranks=4,8", "window=[0,2.5]", "overwrite=true")
    config = toy(conf, *words)
    assert config.fusion == FusionConfig(voxel=1.0, tau=1e-3, lift="center", ranks=(4, 8), window=(0.0, 2.5))
    assert isinstance(config.fusion.voxel, float)
    assert isinstance(config.fusion.window[0], float)
    assert (config.seed, config.overwrite) == (3, True)
    assert toy(conf, "ranks=4").fusion.ranks == (4,)
    assert toy(conf, "tau=inf").fusion.tau == math.inf


@pytest.mark.parametrize(
    ("word", "problem"),
    [
        ("fusion.against=[depth", "fusion.against: expected a list, each one of depth, render, got '[depth'"),
        ("voxel=2cm", "fusion.voxel: expected a number, got '2cm' (grid in metres)"),
        ("voxel=nan", "fusion.voxel: expected a number, got nan (grid in metres)"),
        ("voxel=1,2", "fusion.voxel: expected a number, got '1,2' (grid in metres); several values, one run each"),
        ("voxel=${nothing}", "nothing"),
        ("voxel=-1", "fusion.voxel: expected a positive size, got -1.0"),
        ("seed=1.5", "seed: expected a whole number, got 1.5"),
        ("overwrite=yes", "overwrite: expected true or false, got 'yes'"),
        ("lift=centr", "fusion.lift: expected one of center, blend, got 'centr'; did you mean center?"),
        ("window=1", "fusion.window: expected a list of 2 (a number, a number), got [1]"),
        ("ranks=a", "fusion.ranks: expected a list, each a whole number, got ['a']"),
        ("voxle=1", "voxle: no such option, and no file has this name; did you mean fusion.voxel?"),
        ("fusion={voxel:1}", "fusion: is a section; set its options one by one: fusion.voxel=, fusion.lift=, "),
        ("+seed=1", "+seed=…: is neither an option (KEY=VALUE) nor an existing file"),
        ("hydra.run.dir=x", "hydra.run.dir: settings of Hydra itself are accepted only with -m"),
        ("seed", "seed: needs a value: seed=…"),
        ("teacher=label", "teacher: expected one of dinov2, labels, onnx, got 'label'; did you mean labels?"),
        ("teacher.top_k=3", "teacher.top_k: is an option of teacher=onnx, and teacher is labels"),
        ("voxel=1 fusion.voxel=2", "fusion.voxel: given twice, as '1' and '2'"),
        ("out=", "out: is empty; name where the results go, or leave it out"),
        ("a paths=b", "given both as paths= and as the word 'a'"),
    ],
)
def test_a_wrong_setting_is_told_in_one_line_with_its_full_key(conf: Path, word: str, problem: str) -> None:
    with pytest.raises(InputError) as caught:
        toy(conf, *word.split(" "))
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_short_name_of_two_options_must_be_written_out(conf: Path) -> None:
    @dataclass(frozen=True, slots=True, kw_only=True)
    class Twice(CommonConfig):
        one: FusionConfig = field(default_factory=FusionConfig)
        two: FusionConfig = field(default_factory=FusionConfig)

    with pytest.raises(InputError, match=r"voxel: stands for more than one option; write one.voxel= or two.voxel="):
        compose("toy", Twice, ["voxel=1"], conf)


def test_of_two_options_of_one_name_the_less_deep_one_is_meant(conf: Path) -> None:
    @dataclass(frozen=True, slots=True, kw_only=True)
    class Deeper:
        fusion: FusionConfig = field(default_factory=FusionConfig)

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Twice(CommonConfig):
        one: Deeper = field(default_factory=Deeper)
        two: FusionConfig = field(default_factory=FusionConfig)

    config = compose("toy", Twice, ["voxel=1"], conf)
    assert config.two.voxel == 1
    assert config.one.fusion.voxel == FusionConfig().voxel


def test_a_choice_selects_the_dataclass_and_a_yaml_file_its_preset(conf: Path) -> None:
    assert toy(conf, "teacher=labels").teacher == LabelsConfig()
    assert toy(conf, "teacher=onnx", "teacher.top_k=3").teacher == OnnxConfig(top_k=3)
    assert toy(conf, "teacher=dinov2").teacher == OnnxConfig(weights="dinov2.onnx")


def test_paths_are_the_words_that_are_no_settings(conf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a=b.ply").touch()
    (tmp_path / "seed=b.ply").touch()
    config = toy(conf, "scene,1", "a=b.ply", "seed=4", "./seed=b.ply", "1")
    assert config.paths == ("scene,1", "a=b.ply", "./seed=b.ply", "1")
    assert config.seed == 4
    assert toy(conf, "--", "seed=4", "--help", "--").paths == ("seed=4", "--help", "--")
    assert toy(conf, "paths=a,b").paths == ("a", "b")


def test_paths_that_a_command_needs_are_asked_for_and_others_refused(conf: Path) -> None:
    with pytest.raises(InputError, match="scene: this command takes no path"):
        compose("common", CommonConfig, ["scene"], conf)
    with pytest.raises(InputError, match="SCENE is missing: scenes"):
        check_required(toy(conf))
    check_required(toy(conf, "scene"))


def test_settings_read_back_are_the_same_settings(conf: Path) -> None:
    config = toy(conf, "scene", "teacher=onnx", "query=a,b", "tau=0.1", "out=x")
    assert from_dict(ToyConfig, settings(config)) == config


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        ({"sed": 1}, "sed: no such option; did you mean seed?"),
        ({"fusion": 3}, "fusion: is a section with options of its own (fusion.NAME=…), got 3"),
        ({"teacher": {"name": "onx"}}, "teacher.name: expected one of labels, onnx, got 'onx'; did you mean onnx?"),
        ({"query": [1]}, "query: expected a list, each text, got '1'"),
        ({"out": 1}, "out: expected a path or null, got 1"),
    ],
)
def test_wrong_yaml_is_told_like_a_wrong_command_line(data: dict[str, Any], problem: str) -> None:
    with pytest.raises(InputError) as caught:
        from_dict(ToyConfig, data)
    assert problem in str(caught.value)


@dataclass(frozen=True, slots=True, kw_only=True)
class _WithSecret:
    key: str = field(default="", metadata={"help": "a key", "secret": True})
    name: str = field(default="", metadata={"help": "a name"})


def test_secrets_are_never_shown() -> None:
    assert settings(_WithSecret(key="s", name="n")) == {"key": HIDDEN, "name": "n"}
    assert settings(_WithSecret()) == {"key": "", "name": ""}


def test_secrets_are_repeated_by_no_error_and_taken_by_no_sweep(tmp_path, capsys):
    for words, problem in (
        (["vlm.key=sk-first1", "vlm.key=sk-second2"], "vlm.key: given twice; give it once"),
        (["vlm.kee=sk-first1"], "vlm.kee: no such option"),
        (["api_key=sk-first1"], "api_key: no such option"),
        (["-m", "vlm.key=choice(sk-first1,sk-second2)", "out=o"], "vlm.key: is not accepted with -m"),
    ):
        assert cli.main(["ask", str(tmp_path), *words]) == 2
        error = capsys.readouterr().err
        assert problem in error
        assert "sk-" not in error


@pytest.mark.parametrize("name", COMMANDS)
def test_a_number_that_is_not_finite_is_refused_by_name(name: str) -> None:
    cls, _ = COMMANDS[name].load()
    # Without its protocol `score` looks at no option.
    more = {"paths": ["captions"]} if name == "score" else {}
    for option in options_of(cls):
        if "." not in option.key and {int, float} & {*union_members(option.annotation)}:
            for value in (math.nan, math.inf):
                with pytest.raises(InputError, match=rf"^([\w, ]+, )?{option.key}(,[\w, ]+)?: expected"):
                    from_dict(cls, {option.key: value} | more)


HOSTILE = [
    "mug,banana", "What's red?", "日本語 🥄", "1e-3", "null", "  x ", "${oc.env:HOME}", "${", "", "a\r\nb", '\\"',
    "[a,b]", "~x", "???", "choice(a,b)", "a#b", "%s %(x)s {0}", "${text:x41}", "\u2028", "\x7f\x1b[31m",
    "\udcff",
]  # fmt: skip


def test_text_arrives_as_it_was_typed(conf: Path) -> None:
    for text in HOSTILE:
        config = toy(conf, f"question={text}", f"query={text}", f"teacher.table={text}")
        assert config.question == text
        assert config.query == split_list(text)
        assert isinstance(config.teacher, LabelsConfig)
        assert config.teacher.table == (Path(text) if text else None)


@given(
    st.text(st.characters(exclude_characters="\0"), max_size=30),
    st.lists(st.text(st.characters(exclude_characters="\\\0"), max_size=8), max_size=12),
)
@hypothesis_settings(max_examples=12, deadline=None)
@pytest.mark.slow
def test_any_text_arrives_as_it_was_typed(conf: Path, text: str, words: list[str]) -> None:
    words = [word for word in words if word]
    config = toy(conf, f"question={text}", f"query={join_list(words)}", "--", *words)
    assert config.question == text
    assert config.query == tuple(words)
    assert config.paths == tuple(words)


@given(st.lists(st.text(st.sampled_from("a, "), max_size=6), max_size=5))
def test_a_list_of_text_can_be_written_whatever_its_items_hold(items: list[str]) -> None:
    if items != [""]:
        assert split_list(join_list(items)) == tuple(items)


def test_a_backslash_matters_only_before_a_comma() -> None:
    written = {"": (), "mug,red cup": ("mug", "red cup"), "a\\,b": ("a,b",), "a\\nb": ("a\\nb",), ",": ("", "")}
    for text, items in written.items():
        assert split_list(text) == items


def test_a_list_of_words_may_have_brackets_and_those_around_text_are_text(conf: Path) -> None:
    for value in ("depth,render", "[depth,render]", "[ depth , render ]"):
        assert toy(conf, f"fusion.against={value}").fusion.against == ("depth", "render")
    assert toy(conf, "query=[red],mug").query == ("[red]", "mug")
