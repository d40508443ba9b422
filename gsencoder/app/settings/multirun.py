"""Several runs from one command line (`-m`), by Hydra's multirun, sweepers and launchers.

Values follow Hydra's grammar here (`voxel=0.01,0.02`, `teacher=labels,palette`), except for text, which is taken
literally unless it has the form `query=choice(mug,banana)`. Run k writes to OUT/k; Hydra leaves its `multirun.yaml` in
OUT.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from gsencoder.app.runs.printable import one_line
from gsencoder.app.settings.choices import Choices, choices_of
from gsencoder.app.settings.compose import SWEPT_TEXT, open_hydra, overrides, plain_settings, read_words, seal, unseal
from gsencoder.app.settings.config import CommonConfig, typed
from gsencoder.app.settings.hydra_errors import hydra_error
from gsencoder.app.settings.options import join_list
from gsencoder.app.settings.several import check_single
from gsencoder.core.errors import InputError

# A launcher that runs jobs in other processes imports this module there before it resolves the settings.
OmegaConf.register_new_resolver("text", unseal, replace=True)


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
        config = typed(cls, data)
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


def run_many(
    command: str,
    cls: type[CommonConfig],
    words: Sequence[str],
    run: Callable[[Any], str],
    conf: Path | None = None,
) -> int:
    """Calls `run(settings)` for every combination of the values given and returns the exit code: 2 if one failed.

    Args:
        command: its name.
        cls: the class of its settings.
        words: the command line after the command.
        run: does one run, prints its error and returns it; an empty text for none.
        conf: folder of YAML files; None = the package's.

    Raises:
        InputError: the words are not settings of this command, out= is missing, or the launcher fails.
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
        "hydra.sweep.dir": seal(texts["out"]),
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
