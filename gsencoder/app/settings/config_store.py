"""Hydra's config store, filled from a command's settings class, so that defaults stand in the dataclasses alone.

One node holds all defaults of the command. Beside it are the config groups, for what can be chosen by name:
- a field whose type is a union of dataclasses; each of them is a member (`teacher=onnx`);
- a section with presets; `field(…, metadata={"preset": "tiny"})` names the member that is its default (`model=tiny`);
- `preset`, whose members set options of several sections from the table in `gsencoder.app.settings.presets`;
- `experiment` of a command that has experiments (`CommonConfig.has_experiments`); its member `none` sets nothing.
YAML files in the folder of a group are further members. They set only what differs from the member they build on.

The nodes are plain dicts: OmegaConf makes a node of a frozen dataclass read-only, and refuses Literal.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any

from gsencoder.app.settings.config import CommonConfig, settings
from gsencoder.app.settings.options import LIKE_GROUP, cached, field_types, member_name, section_classes
from gsencoder.app.settings.presets import DEFAULT_PRESET, PRESET, PRESETS, preset_node

EXPERIMENT = "experiment"
"""The group whose members set options of several sections; they are merged last, after the command's own defaults and
presets."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """A config group: named settings of one section, of which a command line chooses one, `KEY=MEMBER`.

    Attributes:
        key: the section, with a slash before a nested one; also the name of the folder of YAML files.
        default: name of the member that is used by default.
        members: the settings of the members that the dataclasses define, as plain dicts.
    """

    key: str
    default: str
    members: Mapping[str, dict[str, Any]]


@cached
def groups_of(cls: type[CommonConfig]) -> tuple[Group, ...]:
    """The config groups of a command, in order of declaration, presets and experiments last."""
    groups = list(_section_groups(cls()))
    presets = {name: {PRESET + LIKE_GROUP: name, **preset_node(cls, name)} for name in PRESETS}
    groups.append(Group(key=PRESET, default=DEFAULT_PRESET, members=presets))
    if cls.has_experiments:
        groups.append(Group(key=EXPERIMENT, default="none", members={"none": {}}))
    return tuple(groups)


def _section_groups(config: Any, prefix: str = "") -> Iterator[Group]:
    annotations = field_types(type(config))
    for item in fields(config):
        key, default = prefix + item.name, getattr(config, item.name)
        classes = section_classes(annotations[item.name])
        if len(classes) > 1:
            configs = [default if type(default) is section else section() for section in classes]
            members = {member_name(type(each)): settings(each) for each in configs}
            yield Group(key=key, default=member_name(type(default)), members=members)
        elif "preset" in item.metadata:
            name = item.metadata["preset"]
            yield Group(key=key, default=name, members={name: settings(default)})
        elif classes:
            yield from _section_groups(default, key + "/")


def store_settings(command: str, cls: type[CommonConfig]) -> None:
    """Stores the defaults of a command and the members of its groups in Hydra's config store; earlier ones are
    replaced."""
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
