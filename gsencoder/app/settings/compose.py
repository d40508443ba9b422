"""Composition of a command line into settings by Hydra, with text taken literally.

Hydra's override grammar is made for numbers and sweeps. In it `query=mug,banana` is a sweep, `question=What's red?` a
syntax error, `query=1` a number, `query=${oc.env:HOME}` a look-up. Options whose type is text, a path, or a list of
those therefore bypass it: their characters are encoded as hexadecimal digits inside an interpolation,
`${text:x6d7567}`, which OmegaConf resolves to the same characters when the settings are complete.

Rules for words: one of the form `KEY=VALUE` sets an option if KEY is one; otherwise it is a path if a file of that
name exists, and an error if not. Every other word is a path. After `--` all words are paths. KEY may leave out the
sections before the last dot where that is unambiguous (`voxel=` for `fusion.voxel=`); of several options with one last
part, the one with the fewest sections before it.
"""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from gsencoder.app.settings.choices import Choices, choices_of, conf_folder, full_key, option_of_several
from gsencoder.app.settings.config import CommonConfig, typed
from gsencoder.app.settings.config_store import EXPERIMENT, store_settings
from gsencoder.app.settings.hydra_errors import HYDRA_KEY, hydra_error
from gsencoder.app.settings.options import (
    LIKE_GROUP,
    Option,
    join_list,
    near,
    without_value,
    wrong_value,
)
from gsencoder.app.settings.several import check_options_of_one, check_single, members_of
from gsencoder.core.errors import InputError
from gsencoder.core.settings import check_removed_option, removed_option

Config = TypeVar("Config", bound=CommonConfig)

SWEPT_TEXT = re.compile(r"choice\(.*\)", re.DOTALL)
"""Form of the value of a text option that is swept, with -m."""


def seal(text: str) -> str:
    """Encodes text as a value in Hydra's grammar that resolves to exactly this text."""
    digits = text.encode("utf-8", "surrogatepass").hex()
    return f"'${{text:x{digits}}}'"


def unseal(digits: str) -> str:
    """Decodes the digits that `seal` wrote."""
    return bytes.fromhex(digits[1:]).decode("utf-8", "surrogatepass")


@contextmanager
def open_hydra(command: str, cls: type[CommonConfig], conf: Path | None) -> Iterator[Any]:
    """Initializes Hydra with the defaults of a command and a folder of YAML files; its errors become InputErrors."""
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    OmegaConf.register_new_resolver("text", unseal, replace=True)
    store_settings(command, cls)
    folder = str((conf or conf_folder()).resolve())
    try:
        with initialize_config_dir(config_dir=folder, job_name="gsencoder", version_base="1.3"):
            yield GlobalHydra.instance().hydra
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(" ".join(str(error).split())) from error


def read_words(
    words: Sequence[str], choices: Choices, *, sweep: bool = False
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Splits a command line into paths and settings, by the rules in the docstring of this module.

    Raises:
        InputError: a word that is neither, a setting given twice, or paths for a command without paths.
    """
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
        elif full is None and (removed := removed_option(key, choices.options)) is not None:
            check_removed_option(removed, value)
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


def overrides(texts: Mapping[str, str], choices: Choices, *, sweep: bool = False) -> list[str]:
    """The settings in Hydra's grammar, with text encoded; each is parsed separately, so that errors name it.

    Raises:
        InputError: an unknown member of a choice, or a value of the wrong type.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser = OverridesParser.create()
    hydra_overrides = []
    check_options_of_one(texts, choices)
    for key, value in texts.items():
        option = choices.options.get(key) or option_of_several(key, choices)
        if option is not None and option.several:
            hydra_overrides += members_of(key, value, option.several, choices.groups[option.several])
            continue
        text = value
        if key in choices.groups:
            names = choices.groups[key]
            # Hydra merges several experiments in the order in which they are listed.
            several = re.fullmatch(r"\[(.*)\]", value) if key == EXPERIMENT else None
            secret = any(name.startswith(f"{key}.") and each.secret for name, each in choices.options.items())
            members = several[1].replace(" ", "").split(",") if several else [value]
            if repeated := [name for name in members if members.count(name) > 1]:
                raise InputError(f"{key}: {repeated[0]} is given twice in {value}; give it once")
            unknown = [name for name in members if name not in names]
            if unknown and (secret or not sweep):
                actual = "" if secret else f", got {unknown[0]!r}{near(unknown[0], names)}"
                raise InputError(f"{key}: expected one of {', '.join(names)}{actual}")
        elif option is not None and option.kind != "value":
            if not (sweep and SWEPT_TEXT.fullmatch(value)):
                # Users of Hydra write brackets around a list; text may begin with one, names do not.
                bracketed = option.names and re.fullmatch(r"\[(.*)\]", value)
                text = seal(re.sub(r"\s*,\s*", ",", bracketed[1].strip()) if bracketed else value)
        elif option is not None and not sweep and _is_list(option) and not value.startswith("["):
            text = f"[{value}]"
        name = option.hydra_key if option is not None and option.like_group and key not in choices.groups else key
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


def _is_list(option: Option) -> bool:
    return getattr(option.annotation, "__origin__", None) is tuple


def compose(
    command: str, cls: type[Config], words: Sequence[str], conf: Path | None = None, choices: Choices | None = None
) -> Config:
    """Composes the settings of a run: defaults of the class, then chosen YAML files, then the command line.

    Raises:
        InputError: the words, or their combination, are not settings of this command.
    """
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
        return typed(cls, data)


def plain_settings(composed: Any) -> dict[str, Any]:
    """The composed settings as plain dicts, lists and scalars, without Hydra's own."""
    from omegaconf import OmegaConf

    settings = OmegaConf.masked_copy(composed, [key for key in composed if key != "hydra"])
    data = OmegaConf.to_container(settings, resolve=True)
    assert isinstance(data, dict)
    return {str(key).removesuffix(LIKE_GROUP): value for key, value in data.items()}
