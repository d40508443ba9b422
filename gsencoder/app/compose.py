"""From a command line to settings: Hydra composes them, with text taken literally; also several runs from one line.

Hydra's override grammar is made for numbers and sweeps. In it `query=mug,banana` is a sweep, `question=What's red?` a
syntax error, `query=1` a number, `query=${oc.env:HOME}` a look-up. Options whose type is text, a path, or a list of
those therefore bypass it: their characters are encoded as hexadecimal digits inside an interpolation,
`${text:x6d7567}`, which OmegaConf resolves to the same characters when the settings are complete.

Rules for words: one of the form `KEY=VALUE` sets an option if KEY is one; otherwise it is a path if a file of that
name exists, and an error if not. Every other word is a path. After `--` all words are paths. KEY may leave out the
sections before the last dot where that is unambiguous (`voxel=` for `fusion.voxel=`); of several options with one last
part, the one with the fewest sections before it.

Hydra's config store is filled from a command's settings class. One node holds all defaults of the command; the config
groups (`gsencoder.app.options`) hold what can be chosen by name. The nodes are plain dicts: OmegaConf makes a node of a
frozen dataclass read-only, and refuses Literal.

With `-m`, values follow Hydra's grammar (`voxel=0.01,0.02`, `teacher=labels,palette`), except for text, which is taken
literally unless it has the form `query=choice(mug,banana)`. Run k writes to OUT/k; Hydra leaves its `multirun.yaml` in
OUT.
"""

import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar, cast, get_args, get_origin

from omegaconf import OmegaConf

from gsencoder.app.options import (
    EXPERIMENT,
    LIKE_GROUP,
    PRESET,
    Choices,
    CommonConfig,
    Option,
    choices_of,
    conf_folder,
    describe,
    field_types,
    groups_of,
    kind_of,
    list_items,
    member_name,
    near,
    options_by_key,
    section_classes,
    settings,
    union_members,
    without_value,
)
from gsencoder.core.errors import InputError, one_line

T = TypeVar("T")
Config = TypeVar("Config", bound=CommonConfig)
HYDRA_KEY = re.compile(r"\+{0,2}hydra[./]")
"""Settings of Hydra itself, with -m; + adds one, as `+hydra.launcher.additional_parameters.account=…`."""
SWEPT_TEXT = re.compile(r"choice\(.*\)", re.DOTALL)
"""Form of the value of a text option that is swept, with -m."""


def split_list(text: str) -> tuple[str, ...]:
    """Splits a list of text: commas separate items, `\\,` is a comma; the empty text is the empty list."""
    return tuple(item.replace("\\,", ",") for item in re.split(r"(?<!\\),", text)) if text else ()


def join_list(items: Iterable[str]) -> str:
    """The text that `split_list` splits into these items."""
    return ",".join(item.replace(",", "\\,") for item in items)


def option_of_several(key: str, choices: Choices) -> Option | None:
    """The option that `teachers.NAME.OPTION` stands for, which is that of the choice `teacher`; None for other keys."""
    field, _, rest = key.partition(".")
    name, _, last = rest.partition(".")
    several = choices.options[field].several if field in choices.options else ""
    return choices.options.get(f"{several}.{last}") if several and name and last else None


def full_key(key: str, choices: Choices) -> str | None:
    """The option or choice that `key` stands for, or None."""
    keys = [*choices.options, *choices.groups]
    if key in keys or option_of_several(key, choices) is not None:
        return key
    depths = {name: len(parts) for name in keys if (parts := re.split(r"[./]", name))[-1] == key}
    # An option of a section within a section gives way to one that is less deep.
    ends = [name for name, depth in depths.items() if depth == min(depths.values())]
    if len(ends) > 1:
        raise InputError(f"{key}: stands for more than one option; write {' or '.join(f'{end}=' for end in ends)}")
    return ends[0] if ends else None


def read_words(
    words: Sequence[str], choices: Choices, *, sweep: bool = False
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Splits a command line into paths and settings, by the rules in the docstring of this module."""
    paths: list[str] = []
    texts: dict[str, str] = {}
    only_paths = False
    for word in words:
        key, equals, value = word.partition("=")
        if only_paths or not equals:
            if word == "--" and not only_paths:
                only_paths = True
                continue
            if not only_paths and not os.path.lexists(word) and full_key(word, choices):
                raise InputError(f"{word}: needs a value: {word}=…")
            if not word:
                raise InputError("a path is empty; leave it out or name a file")
            paths.append(word)
            continue
        full = key if sweep and HYDRA_KEY.match(key) else full_key(key, choices)
        if full in choices.groups and re.fullmatch(r"\[.*\]", value):
            # Several members of a choice, where the command takes several, are an option of their own.
            full = next((name for name, option in choices.options.items() if option.several == full), full)
        if full is None and os.path.lexists(word):
            paths.append(word)
        elif full is None:
            raise InputError(_unknown(word, key, choices))
        elif full in texts:
            secret = full in choices.options and choices.options[full].secret
            values = "" if secret else f", as {texts[full]!r} and {value!r}"
            raise InputError(f"{full}: given twice{values}; give it once")
        elif sweep and full in choices.options and choices.options[full].secret:
            raise InputError(f"{full}: is not accepted with -m, which writes its values to a file")
        elif full == "out" and not value:
            # A variable of a script that is not set would write to the usual folder without a word.
            raise InputError("out: is empty; name where the results go, or leave it out")
        else:
            texts[full] = value
    if paths and "paths" not in choices.options:
        keys = [*choices.options, *choices.groups]
        first = without_value(paths[0])
        raise InputError(f"{first}: this command takes no path{near(first, keys)}")
    if paths and "paths" in texts:
        raise InputError(f"paths: given both as paths= and as the word {without_value(paths[0])!r}; give one of them")
    return tuple(paths), texts


def _unknown(word: str, key: str, choices: Choices) -> str:
    keys, bare_word = [*choices.options, *choices.groups], without_value(word)
    single = key.partition(".")[0].removesuffix("s")
    only_one = not any(option.several for option in choices.options.values())
    if only_one and single in choices.groups and key.startswith(f"{single}s"):
        return f"{key}: this command takes a single {single}; give {single}= and its options as {single}.OPTION="
    sections = [name for name in keys if name.startswith(key + ".")]
    if sections:
        return f"{key}: is a section; set its options one by one: {', '.join(f'{name}=' for name in sections[:4])}"
    if not re.fullmatch(r"[A-Za-z_][\w.]*", key):
        return f"{bare_word}: is neither an option (KEY=VALUE) nor an existing file"
    if key.startswith("hydra"):
        return f"{key}: settings of Hydra itself are accepted only with -m"
    return f"{bare_word.removesuffix('=…')}: no such option, and no file has this name{near(bare_word, keys)}"


def check_member(key: str, member: str, choices: Choices, kind: str = "one") -> None:
    """Checks that a choice has a member."""
    names = choices.groups.get(key) or choices.groups[choices.options[key].several]
    if member not in names:
        raise InputError(f"{key}: expected {kind} of {', '.join(names)}, got {member!r}{near(member, names)}")


def named_members(value: str) -> list[tuple[str, str]]:
    """The names and members of a list such as [labels,dino:onnx]; a member without a name has its own."""
    words = [word.strip() for word in value.removeprefix("[").removesuffix("]").split(",") if word.strip()]
    return [(word.partition(":")[0], word.partition(":")[2] or word) for word in words]


def members_of(key: str, value: str, choices: Choices) -> list[str]:
    """Overrides that add several members of a choice, each below a name of its own."""
    pairs, group = named_members(value), choices.options[key].several
    names = [name for name, _ in pairs]
    if not pairs:
        raise InputError(f"{key}: expected one or more of {', '.join(choices.groups[group])}, got {value!r}")
    for name, member in pairs:
        check_member(key, member, choices, "some")
        if names.count(name) > 1:
            raise InputError(f"{key}: {name} is given twice; give other names, such as {name}_2:{member}")
        if not re.fullmatch(r"\w+", name, re.ASCII):
            raise InputError(f"{key}: expected names of letters, digits and _, got {name!r}")
    return [f"+{group}@{key}.{name}={member}" for name, member in pairs]


def check_single(data: Mapping[str, Any], texts: Mapping[str, str], choices: Choices) -> None:
    """Checks that nothing was given for a single member of a choice where the command line or an experiment gives
    several."""
    for key, option in choices.options.items():
        single = option.several
        unused = [name for name in texts if single and (name == single or name.startswith(f"{single}."))]
        if unused and (key in texts or data.get(key)):
            source = key if key in texts else EXPERIMENT
            name = unused[0].partition(".")[2] or "OPTION"
            raise InputError(
                f"{unused[0]}: is for a single {single}, and {source}={texts.get(source, '')} gives several; leave it "
                f"out, or write {key}.NAME.{name}=… for one of them"
            )


def encode_text(text: str) -> str:
    """Encodes text as a value in Hydra's grammar that resolves to exactly this text."""
    digits = text.encode("utf-8", "surrogatepass").hex()
    return f"'${{text:x{digits}}}'"


def decode_text(digits: str) -> str:
    """Decodes the digits that `encode_text` wrote."""
    return bytes.fromhex(digits[1:]).decode("utf-8", "surrogatepass")


# A launcher that runs jobs in other processes imports this module there before it resolves the settings.
OmegaConf.register_new_resolver("text", decode_text, replace=True)


def wrong_value(option: Option, value: Any) -> str:
    """The message for a value of the wrong type."""
    if isinstance(value, (list, tuple)) and option.kind == "list":
        value = join_list(map(str, value))
    members = union_members(option.annotation)
    words = [each for member in members for each in (member, *list_items(member)) if get_origin(each) is Literal]
    hint = near(str(value), [str(word) for each in words for word in get_args(each)])
    is_list = any(get_origin(member) is tuple for member in members)
    if is_list and option.kind == "value" and isinstance(value, str) and "," in value:
        hint = f"; a list of numbers stands in brackets: {option.key}=[{value}]"
    meaning = f" ({option.help})" if option.help and not hint else ""
    return f"{option.key}: expected {describe(option.annotation)}, got {value!r}{hint}{meaning}"


def overrides(texts: Mapping[str, str], choices: Choices, *, sweep: bool = False) -> list[str]:
    """The settings in Hydra's grammar, with text encoded; each is parsed separately, so that errors name it."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser = OverridesParser.create()
    hydra_overrides = []
    check_single({}, texts, choices)
    for key, value in texts.items():
        option = choices.options.get(key) or option_of_several(key, choices)
        if option is not None and option.several:
            hydra_overrides += members_of(key, value, choices)
            continue
        text = value
        if key in choices.groups:
            # Hydra merges several experiments in the order in which they are listed.
            several = re.fullmatch(r"\[(.*)\]", value) if key == EXPERIMENT else None
            members = several[1].replace(" ", "").split(",") if several else [value]
            if repeated := [name for name in members if members.count(name) > 1]:
                raise InputError(f"{key}: {repeated[0]} is given twice in {value}; give it once")
            for member in members if not sweep else ():
                check_member(key, member, choices)
        elif option is not None and option.kind != "value":
            if not (sweep and SWEPT_TEXT.fullmatch(value)):
                # Users of Hydra write brackets around a list; text may begin with one, names do not.
                bracketed = option.names and re.fullmatch(r"\[(.*)\]", value)
                text = encode_text(re.sub(r"\s*,\s*", ",", bracketed[1].strip()) if bracketed else value)
        elif option is not None and not sweep and get_origin(option.annotation) is tuple and not value.startswith("["):
            text = f"[{value}]"
        # An option of several members has its key, whatever option of a single one it stands for.
        name = choices.options[key].hydra_key if key in choices.options and key not in choices.groups else key
        try:
            parsed = parser.parse_override(f"{name}={text}")
            swept = parsed.is_sweep_override()
        except HydraException as error:
            message = wrong_value(option, value) if option else f"{key}={value}: {str(error).partition(chr(10))[0]}"
            raise InputError(message) from error
        if swept and not sweep and option is not None:
            raise InputError(f"{wrong_value(option, value)}; several values, one run each, need -m")
        hydra_overrides.append(f"{name}={text}")
    return hydra_overrides


def store_settings(command: str, cls: type[CommonConfig]) -> None:
    """Stores the defaults of a command and the members of its groups in Hydra's config store."""
    from hydra.core.config_store import ConfigStore

    store = ConfigStore.instance()
    node, before, after = settings(cls()), [], []
    for item in fields(cls):
        if item.metadata.get("like_group"):
            node[item.name + LIKE_GROUP] = node.pop(item.name)
    for group in groups_of(cls):
        is_global = group.key in (PRESET, EXPERIMENT)
        for name, member in group.members.items():
            store.store(name=name, node=member, group=group.key, package="_global_" if is_global else None)
        if is_global:
            after.append({group.key: group.default})
        else:
            before.append({group.key: group.default})
            *sections, last = group.key.split("/")
            inner = node
            for section in sections:
                inner = inner[section]
            del inner[last]
    store.store(name=command, node={"defaults": [*before, "_self_", *after], **node})


@contextmanager
def open_hydra(command: str, cls: type[CommonConfig], conf: Path | None) -> Iterator[Any]:
    """Initializes Hydra with the defaults of a command and a folder of YAML files; its errors become InputErrors."""
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    store_settings(command, cls)
    folder = str((conf or conf_folder()).resolve())
    try:
        with initialize_config_dir(config_dir=folder, job_name="gsencoder", version_base="1.3"):
            yield GlobalHydra.instance().hydra
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(" ".join(str(error).split())) from error


def hydra_error(error: Exception, texts: Mapping[str, str], choices: Choices) -> str:
    """The message of an error of Hydra, explained where an option belongs to a member that was not chosen."""
    text = " ".join(str(error).split())
    if launcher := re.search(r"Could not find 'hydra/launcher/([^']+)'", text):
        return (
            f"hydra/launcher={launcher[1]}: no such launcher is installed; submitit_slurm and submitit_local come with "
            "pip install 'gsencoder[slurm]'"
        )
    if twice := re.search(r"(\w+)@(\w+)\.(\w+) appears more than once", text):
        return (
            f"{twice[2]}.{twice[3]}: is given by {EXPERIMENT}={texts.get(EXPERIMENT, '')} and once more; leave out "
            f"{twice[1]}=, since those of an experiment cannot be replaced, or leave out {EXPERIMENT}="
        )
    if (absent := re.search(r"Could not find '(\w+)/([^']+)'", text)) and absent[1] in choices.groups:
        check_member(absent[1], absent[2], choices)
    match = re.search(r"Could not override '([^']+)'", text)
    key = match[1] if match else ""
    if key not in texts:
        return text
    if HYDRA_KEY.match(key):
        return f"{key}: Hydra has no such setting; +{key}=… adds an entry to a table such as additional_parameters"
    section = key.rpartition(".")[0]
    if key in choices.options:
        group = next((name for name in choices.groups if name.replace("/", ".") == section), section)
        now = texts.get(group, choices.chosen.get(group))
        return f"{key}: is an option of {' and '.join(choices.members[key]) or section}, and {group} is {now}"
    field, _, name = section.partition(".")
    single = field.removesuffix("s")
    member = dict(named_members(texts.get(field, ""))).get(name)
    if member is None:
        return f"{key}: there is no {name} among the {field} of this run; {field}= names them"
    owners = choices.members.get(f"{single}.{key.rpartition('.')[2]}", ())
    return f"{key}: is an option of {' and '.join(owners)}, and {name} is {single}={member}"


def plain_settings(composed: Any) -> dict[str, Any]:
    """The composed settings as plain dicts, lists and scalars, without Hydra's own."""
    own = OmegaConf.masked_copy(composed, [key for key in composed if key != "hydra"])
    data = cast(dict[str, Any], OmegaConf.to_container(own, resolve=True))
    return {key.removesuffix(LIKE_GROUP): value for key, value in data.items()}


def _number(target: type, accepted: tuple[type, ...]) -> Any:
    """A dacite hook that converts numbers of the accepted types to `target`, and refuses all else, and NaN."""
    from dacite.exceptions import WrongTypeError

    def convert(value: Any) -> Any:
        if not isinstance(value, accepted) or isinstance(value, bool) or value != value:
            raise WrongTypeError(field_type=target, value=value)
        return target(value)

    return convert


def _prepare(value: Any, annotation: Any) -> Any:
    """Splits text of lists, makes a list of a single value where one is expected, and None of an empty path."""
    if value is None:
        return None
    if isinstance(value, str) and kind_of(annotation) == "list":
        return split_list(value)
    members = union_members(annotation)
    if all(get_origin(member) is tuple for member in members) and not isinstance(value, (list, tuple, dict)):
        return (value,)
    return None if value == "" and Path in members and type(None) in get_args(annotation) else value


def _section(annotation: Any, value: Any, key: str) -> Any:
    if get_origin(annotation) is Mapping and section_classes(get_args(annotation)[1]):
        if not isinstance(value, Mapping):
            raise InputError(f"{key}: expected settings by name ({key}.NAME.OPTION=…), got {value!r}")
        return {str(name): _section(get_args(annotation)[1], each, f"{key}.{name}") for name, each in value.items()}
    classes = section_classes(annotation)
    if not classes or (value is None and type(None) in get_args(annotation)):
        return value
    if not isinstance(value, Mapping):
        raise InputError(f"{key}: is a section with options of its own ({key}.NAME=…), got {value!r}")
    if len(classes) == 1:
        return from_dict(classes[0], value, key + ".")
    by_name = {member_name(section): section for section in classes}
    name = str(value.get("name"))
    if name not in by_name:
        raise InputError(f"{key}.name: expected one of {', '.join(by_name)}, got {name!r}{near(name, by_name)}")
    return from_dict(by_name[name], value, key + ".")


def _named(message: str, prefix: str, names: Iterable[str]) -> str:
    """The message of an error of a settings class, with the name of the section before that of each field."""
    head, _, problem = message.partition(":")
    named = re.split(r"(, | and )", head)
    if not prefix or any(name.split("[")[0] not in names for name in named[::2]):
        return f"{prefix.rstrip('.')}: {message}" if prefix else message
    return f"{''.join(prefix + word if index % 2 == 0 else word for index, word in enumerate(named))}:{problem}"


def from_dict(cls: type[T], data: Mapping[str, Any], prefix: str = "") -> T:
    """Builds settings from plain dicts, lists and scalars; missing options have their defaults."""
    import dacite
    from dacite.exceptions import DaciteFieldError

    types = field_types(cls)
    values: dict[str, Any] = {}
    for name, value in data.items():
        if name not in types:
            raise InputError(f"{prefix}{name}: no such option{near(prefix + name, [prefix + each for each in types])}")
        values[name] = _prepare(_section(types[name], value, prefix + name), types[name])
    hooks: dict[Any, Any] = {
        int: _number(int, (int,)),
        float: _number(float, (int, float)),
        Path: lambda value: Path(value) if isinstance(value, str) and value else value,
    }
    try:
        return dacite.from_dict(cls, values, dacite.Config(strict=True, cast=[tuple], type_hooks=hooks))
    except DaciteFieldError as error:
        name = str(error.field_path).partition(".")[0]
        raise InputError(wrong_value(options_by_key(cls, prefix)[prefix + name], data.get(name))) from error
    except InputError as error:
        raise InputError(_named(str(error), prefix, types)) from error


def compose(
    command: str, cls: type[Config], words: Sequence[str], conf: Path | None = None, choices: Choices | None = None
) -> Config:
    """Composes the settings of a run: defaults of the class, then chosen YAML files, then the command line."""
    from hydra.errors import HydraException
    from hydra.types import RunMode

    choices = choices or choices_of(cls, conf)
    paths, texts = read_words(words, choices)
    if paths:
        texts["paths"] = join_list(paths)
    lines = overrides(texts, choices)
    with open_hydra(command, cls, conf) as hydra:
        try:
            composed = hydra.compose_config(command, lines, RunMode.RUN, from_shell=False)
        except HydraException as error:
            raise InputError(hydra_error(error, texts, choices)) from error
        data = plain_settings(composed)
        check_single(data, texts, choices)
        return from_dict(cls, data)


def _job(
    composed: Any,
    *,
    cls: type[CommonConfig],
    run: Callable[[Any], str],
    swept: Sequence[str],
    texts: Mapping[str, str],
    choices: Choices,
) -> str:
    """Runs one job in its folder and returns its error, so that a failed run does not stop the others."""
    from hydra.core.hydra_config import HydraConfig

    job = HydraConfig.get()
    try:
        data = plain_settings(composed)
        check_single(data, texts, choices)
        config = from_dict(cls, data)
    except InputError as error:
        message = f"run {job.job.num}: {error}"
        print(one_line(f"error: {message}"), file=sys.stderr)
        return message
    assert config.out is not None
    if not config.quiet:
        values = [text for text in job.overrides.task if text.partition("=")[0] in swept]
        print(one_line(f"run {job.job.num}: {' '.join(values)}"), file=sys.stderr)
    # Workers share the scenes of one output folder.
    shared = set(swept) == {"worker"}
    return run(config if shared else replace(config, out=config.out / str(job.job.num)))


def run_sweep(
    command: str,
    cls: type[CommonConfig],
    words: Sequence[str],
    run: Callable[[Any], str],
    conf: Path | None = None,
) -> int:
    """Calls `run(settings)` for every combination of the values given and returns the exit code: 2 if one failed.

    Args:
        run: does one run, prints its error and returns it; an empty text for none.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    choices = choices_of(cls, conf)
    paths, texts = read_words(words, choices, sweep=True)
    if paths:
        texts["paths"] = join_list(paths)
    _check_out(command, texts, choices)
    hydra_settings = {
        "hydra.mode": "MULTIRUN",
        "hydra.output_subdir": "null",
        "hydra.sweep.dir": encode_text(texts["out"]),
        "hydra.sweep.subdir": ".",
        "hydra/job_logging": "none",
        "hydra/hydra_logging": "none",
    }
    requested = overrides(texts, choices, sweep=True)
    lines = [f"{key}={value}" for key, value in hydra_settings.items() if key not in texts] + requested
    parsed = OverridesParser.create().parse_overrides(requested)
    swept = tuple(override.get_key_element() for override in parsed if override.is_sweep_override())
    launcher = texts.get("hydra/launcher", "basic")
    job = partial(_job, cls=cls, run=run, swept=swept, texts=texts, choices=choices)
    with open_hydra(command, cls, conf) as hydra:
        try:
            batches = hydra.multirun(command, job, lines, with_log_configuration=False)
        except HydraException as error:
            raise InputError(hydra_error(error, texts, choices)) from error
        except Exception as error:
            # The basic launcher returns the exceptions of a run; others raise their own, of many types.
            if launcher == "basic":
                raise
            raise InputError(
                f"hydra/launcher={launcher}: {error}; the logs of the jobs are in "
                f"{texts['out']}/.submitit unless hydra.launcher.submitit_folder= says otherwise"
            ) from error
    errors = [str(result.return_value) for batch in batches for result in batch]
    failed = [error for error in errors if error]
    if failed:
        if launcher != "basic":
            # Jobs in other processes print into logs of their own; workers of one list may fail at the same scenes.
            for message in dict.fromkeys(line for error in failed for line in error.split("\n")):
                print(one_line(f"error: {message}"), file=sys.stderr)
        print(f"error: {len(failed)} of {len(errors)} runs failed", file=sys.stderr)
    return 2 if failed else 0


def _check_out(command: str, texts: dict[str, str], choices: Choices) -> None:
    if choices.options["out"].metavar == "FILE":
        raise InputError(f"-m: {command} writes a file, and several runs need a folder")
    if not texts.get("out"):
        raise InputError("-m: out= is missing: the folder in which run k writes to OUT/k")
    if SWEPT_TEXT.fullmatch(texts["out"]):
        raise InputError("out: cannot be swept; run k writes to OUT/k")
