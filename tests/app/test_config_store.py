"""A default has one home: what Hydra composes is what the dataclasses say, and YAML holds only what differs from it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import pytest

from gsencoder.app.commands.fuse import FuseCommandConfig
from gsencoder.app.commands.train import TrainCommandConfig
from gsencoder.app.compose import compose, open_hydra, plain_settings, run_sweep
from gsencoder.app.main import COMMANDS
from gsencoder.app.options import (
    EXPERIMENT,
    CommonConfig,
    choices_of,
    conf_folder,
    field_types,
    member_name,
    options_of,
    section_classes,
    settings,
)
from gsencoder.core.errors import InputError

MISSING = object()


def config_of(command: str) -> type[CommonConfig]:
    return COMMANDS[command].load()[0]


@cache
def composed_with(command: str, word: str) -> CommonConfig:
    """The settings with one word, which several tests look at: composing takes a tenth of a second."""
    cls = config_of(command)
    return compose(command, cls, [word], choices=choices_of(cls))


def value_at(data: Any, key: str) -> Any:
    """The value of `a.b.c` in nested dataclasses or dicts; MISSING where there is none."""
    for name in key.split("."):
        data = data.get(name, MISSING) if isinstance(data, Mapping) else getattr(data, name, MISSING)
    return data


def union_members(cls: type, prefix: str = "") -> Iterator[tuple[str, type]]:
    """The key of every choice between dataclasses, sections included, with each of its members."""
    for name, annotation in field_types(cls).items():
        classes = section_classes(annotation)
        for member in classes:
            if len(classes) > 1:
                yield prefix + name, member
            else:
                yield from union_members(member, f"{prefix}{name}.")


def new_groups(command: str) -> set[str]:
    """The choices of a command that no command before it has with the same members and default, in any section."""
    known: set[tuple[str, tuple[str, ...], str]] = set()
    for name in COMMANDS:
        choices = choices_of(config_of(name))
        own = {
            group: (group.rpartition("/")[2], members, choices.chosen[group])
            for group, members in choices.groups.items()
        }
        if name == command:
            return {group for group, choice in own.items() if choice not in known}
        known |= {*own.values()}
    raise KeyError(command)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.slow
def test_every_member_of_every_choice_has_the_defaults_of_its_dataclass_and_the_default_one_changes_nothing(command):
    cls, groups = config_of(command), new_groups(command)
    choices = choices_of(cls)
    for group in groups:
        for member in choices.groups[group]:
            is_default = member == choices.chosen[group]
            assert (composed_with(command, f"{group}={member}") == cls()) == is_default
    for key, member in union_members(cls):
        group = key.replace(".", "/")
        if group in groups:
            assert value_at(composed_with(command, f"{group}={member_name(member)}"), key) == member()


@pytest.mark.parametrize("command", COMMANDS)
def test_every_setting_is_documented_and_known_to_hydra(command: str) -> None:
    from hydra.types import RunMode

    cls = config_of(command)
    with open_hydra(command, cls, None) as hydra:
        composed = plain_settings(hydra.compose_config(command, [], RunMode.RUN, from_shell=False))
    assert options_of(cls)
    for option in options_of(cls):
        assert option.help, f"{command}: {option.key} has no metadata help"
        assert not option.help.endswith("."), f"{command}: {option.key}: help is a phrase, without a full stop"
        assert option.member or value_at(composed, option.key) is not MISSING, f"Hydra does not know {option.key}"


def leaves(data: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """The dotted key of everything that a YAML file sets."""
    for name, value in data.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name


def base_of(group: str, defaults: list[Any]) -> list[str]:
    """The members that a YAML file builds on, by its defaults list, as words of a command line."""
    words, members = [], list[str]()
    for entry in defaults:
        if isinstance(entry, Mapping):
            (overridden, member), *others = entry.items()
            assert not others
            if overridden.startswith("/teacher@teachers."):
                members.append(f"{overridden.removeprefix('/teacher@teachers.')}:{member}")
                continue
            assert overridden.startswith("override /")
            words.append(f"{overridden.removeprefix('override /')}={member}")
        elif entry != "_self_":
            words.append(f"{group}={entry}")
    # Several teachers are an option of their own.
    return [f"teacher=[{','.join(members)}]", *words] if members else words


@pytest.mark.parametrize("path", sorted(conf_folder().rglob("*.*")), ids=lambda path: f"{path.parent.name}/{path.name}")
def test_a_yaml_file_is_a_member_of_a_choice_and_sets_only_what_differs(path: Path) -> None:
    from omegaconf import OmegaConf

    group = path.parent.relative_to(conf_folder()).as_posix()
    commands = [name for name in COMMANDS if group in choices_of(config_of(name)).groups]
    assert commands, f"no command has a choice {group}"
    assert path.suffix == ".yaml"
    cls = config_of(commands[0])
    assert path.stem not in {
        member_name(member) for key, member in union_members(cls) if key.replace(".", "/") == group
    }
    data = OmegaConf.to_container(OmegaConf.load(path))
    assert isinstance(data, dict)
    base = base_of(group, data.pop("defaults", []))
    chosen = choices_of(cls).chosen
    assert path.stem != chosen[group]
    assert not {f"{key}={member}" for key, member in chosen.items()} & {
        word for word in base if word[: len(group)] != group
    }
    before = settings(compose(commands[0], cls, base))
    after = settings(composed_with(commands[0], f"{group}={path.stem}"))
    keys = list(leaves(data, "" if group == EXPERIMENT else group.replace("/", ".") + "."))
    assert keys
    # Several experiments can be composed, so one may also set back what another of them changes.
    others = [each for each in path.parent.glob("*.yaml") if each != path] if group == EXPERIMENT else []
    set_by_others = {key for each in others for key in leaves(OmegaConf.to_container(OmegaConf.load(each)))}
    for key in keys:
        assert value_at(after, key) is not MISSING, f"{key} is no option"
        unchanged = value_at(after, key) == value_at(before, key)
        assert not unchanged or key in set_by_others, f"{key} is what it would be without {path.name}"


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkConfig:
    width: int = field(default=8, metadata={"help": "channels"})
    depth: int = field(default=2, metadata={"help": "blocks"})


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseConfig:
    name: Literal["noise"] = "noise"
    sigma: float = field(default=0.1, metadata={"help": "standard deviation"})


@dataclass(frozen=True, slots=True, kw_only=True)
class BlurConfig:
    name: Literal["blur"] = "blur"
    radius: int = field(default=1, metadata={"help": "pixels"})


@dataclass(frozen=True, slots=True, kw_only=True)
class StudentConfig:
    network: NetworkConfig = field(default_factory=NetworkConfig, metadata={"preset": "tiny"})
    damage: NoiseConfig | BlurConfig = field(default_factory=lambda: NoiseConfig(sigma=0.3))
    rate: float = field(default=0.01, metadata={"help": "learning rate"})


@dataclass(frozen=True, slots=True, kw_only=True)
class ToyConfig(CommonConfig):
    has_experiments: ClassVar[bool] = True

    student: StudentConfig = field(default_factory=StudentConfig)
    teacher: NoiseConfig | BlurConfig = field(default_factory=BlurConfig)


@pytest.fixture(scope="module")
def conf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("conf")
    files = {
        "student/network/large.yaml": "defaults: [tiny, _self_]\nwidth: 64\n",
        "teacher/wide.yaml": "defaults: [blur, _self_]\nradius: 9\n",
        "teacher/wrong.yaml": "defaults: [blur, _self_]\nradios: 9\n",
        "experiment/long.yaml": (
            "# @package _global_\ndefaults:\n  - override /student/network: large\n  - override /teacher: noise\n"
            "student: {rate: 0.5, network: {depth: 7}}\n"
        ),
    }
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def toy(conf: Path, *words: str) -> ToyConfig:
    return compose("toy", ToyConfig, words, conf)


def test_choices_come_from_unions_presets_and_experiments_wherever_their_section_lies(conf: Path) -> None:
    choices = choices_of(ToyConfig, conf)
    assert choices.groups == {
        "student/network": ("large", "tiny"), "student/damage": ("blur", "noise"),
        "teacher": ("blur", "noise", "wide", "wrong"), "preset": ("balanced", "exact", "fast"),
        "experiment": ("long", "none"),
    }  # fmt: skip
    assert choices.chosen == {
        "student/network": "tiny", "student/damage": "noise", "teacher": "blur", "preset": "balanced",
        "experiment": "none",
    }  # fmt: skip
    assert toy(conf) == ToyConfig()
    assert toy(conf, "network=large", "damage=blur", "student.damage.radius=3", "teacher=wide") == ToyConfig(
        student=StudentConfig(network=NetworkConfig(width=64), damage=BlurConfig(radius=3)),
        teacher=BlurConfig(radius=9),
    )


def test_an_experiment_goes_over_the_defaults_and_the_command_line_over_the_experiment(conf: Path) -> None:
    config = toy(conf, "experiment=long")
    assert config.student == StudentConfig(network=NetworkConfig(width=64, depth=7), rate=0.5)
    assert config.teacher == NoiseConfig()
    config = toy(conf, "experiment=long", "network=tiny", "rate=0.25", "teacher=wide")
    assert config.student == StudentConfig(network=NetworkConfig(depth=7), rate=0.25)
    assert config.teacher == BlurConfig(radius=9)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("teacher=wrong", "teacher.radios: no such option; did you mean teacher.radius?"),
        ("student.damage.radius=3", "is an option of student/damage=blur, and student/damage is noise"),
        ("damage=blue", "student/damage: expected one of blur, noise, got 'blue'; did you mean blur?"),
        ("experiment=short", "experiment: expected one of long, none, got 'short'"),
    ],
)
def test_errors_name_the_choice_and_its_members(conf: Path, word: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        toy(conf, word)
    assert message in str(caught.value)


def test_commands_that_share_the_name_of_a_choice_have_their_own_members(conf: Path) -> None:
    @dataclass(frozen=True, slots=True, kw_only=True)
    class OtherConfig(CommonConfig):
        teacher: NetworkConfig = field(default_factory=NetworkConfig, metadata={"preset": "plain"})

    assert toy(conf).teacher == BlurConfig()
    assert compose("other", OtherConfig, ["teacher.width=3"], conf).teacher == NetworkConfig(width=3)
    with pytest.raises(InputError, match="teacher: expected one of plain, wide, wrong, got 'blur'"):
        compose("other", OtherConfig, ["teacher=blur"], conf)
    assert toy(conf).teacher == BlurConfig()


def composed(*words: str) -> TrainCommandConfig:
    return compose("train", TrainCommandConfig, ["ROOMS", *words])


SINGLE = "is for a single teacher, and experiment=house gives several; "
AGAIN = "is given by experiment=house and once more; leave out"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["experiment=house", "teacher=palette"], f"teacher: {SINGLE}"),
        (["experiment=house", "teacher.words=names.npz"], f"teacher.words: {SINGLE}"),
        (["experiment=house", "teacher=[labels,palette]"], f"teachers.labels: {AGAIN}"),
        (["experiment=house", "teachers=[labels]"], f"teachers.labels: {AGAIN}"),
        (["teacher=[labels]", "teachers.palette.cell=4"], ".*there is no palette among the teachers of this run"),
        (["experiment=[house,house]"], r"experiment: house is given twice in \[house,house\]"),
    ],
)
def test_teachers_and_experiments_that_contradict_each_other_are_refused(words: list[str], message: str) -> None:
    with pytest.raises(InputError, match=f"^{message}"):
        composed(*words)


def test_a_single_teacher_has_its_options_and_one_of_several_by_its_name() -> None:
    for word in ("teacher=palette", "teacher.words=names.npz"):
        assert composed(word).teachers == {}
    assert composed("experiment=house", "teachers.dinov2_s14.size=224").teachers["dinov2_s14"].size == 224  # type: ignore[union-attr]
    with pytest.raises(InputError, match="^teachers.labels.words: this command takes a single teacher; give"):
        compose("fuse", FuseCommandConfig, ["ROOM", "teachers.labels.words=names.npz"])


def test_an_experiment_exists_with_several_runs_too(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="^experiment: expected one of house, .*got 'nope'"):
        run_sweep("train", TrainCommandConfig, ["ROOMS", "experiment=house,nope", f"out={tmp_path}"], lambda config: "")


def test_an_empty_list_of_scenes_to_hold_out_replaces_that_of_the_experiment() -> None:
    assert composed("experiment=house").holdout == ("train_04*",)
    for empty in ("holdout=[]", "holdout="):
        assert composed("experiment=house", empty).holdout == ()
    assert composed("holdout=[room_0, room_1*]").holdout == ("room_0", "room_1*")
    assert composed("holdout=room_[0-3]").holdout == ("room_[0-3]",)
