"""Messages for the errors of Hydra that a command line may cause."""

import re
from collections.abc import Mapping

from gsencoder.app.settings.choices import Choices
from gsencoder.app.settings.config_store import EXPERIMENT
from gsencoder.app.settings.options import near
from gsencoder.app.settings.several import named_members

HYDRA_KEY = re.compile(r"\+{0,2}hydra[./]")
"""Settings of Hydra itself, with -m; + adds one, as `+hydra.launcher.additional_parameters.account=…`."""


def hydra_error(error: Exception, texts: Mapping[str, str], choices: Choices) -> str:
    """The message of an error of Hydra; it is explained if an option belongs to a member that was not chosen, or to no
    launcher, or if the launcher is not installed."""
    launcher = re.search(r"Could not find 'hydra/launcher/([^']+)'", str(error))
    if launcher:
        return (
            f"hydra/launcher={launcher[1]}: no such launcher is installed; submitit_slurm and submitit_local come with "
            "pip install 'gsencoder[slurm]'"
        )
    twice = re.search(r"(\w+)@(\w+)\.(\w+) appears more than once", str(error))
    if twice:
        return (
            f"{twice[2]}.{twice[3]}: is given by {EXPERIMENT}={texts.get(EXPERIMENT, '')} and once more; leave out "
            f"{twice[1]}=, since those of an experiment cannot be replaced, or leave out {EXPERIMENT}="
        )
    absent = re.search(r"Could not find '(\w+)/([^']+)'", str(error))
    if absent and absent[1] in choices.groups:
        names = choices.groups[absent[1]]
        return f"{absent[1]}: expected one of {', '.join(names)}, got {absent[2]!r}{near(absent[2], names)}"
    match = re.search(r"Could not override '([^']+)'", str(error))
    if match and match[1] in texts:
        key = match[1]
        if HYDRA_KEY.match(key):
            return f"{key}: Hydra has no such setting; +{key}=… adds an entry to a table such as additional_parameters"
        if key not in choices.options:
            section, _, name = key.rpartition(".")[0].partition(".")
            member = dict(named_members(texts.get(section, ""))).get(name)
            if member is None:
                return f"{key}: there is no {name} among the {section} of this run; {section}= names them"
            owners = choices.members.get(f"{section.removesuffix('s')}.{key.rpartition('.')[2]}")
            whose = " and ".join(owners) if owners else "none of them"
            return f"{key}: is an option of {whose}, and {name} is {section.removesuffix('s')}={member}"
        section = key.rpartition(".")[0]
        group = next((name for name in choices.groups if name.replace("/", ".") == section), section)
        now = texts.get(group, choices.chosen.get(group))
        return f"{key}: is an option of {' and '.join(choices.members[key]) or section}, and {group} is {now}"
    return " ".join(str(error).split())
