"""Presets: `preset=fast|balanced|exact` sets the options of a command that trade cost for accuracy.

`balanced` is the defaults. A row of the table holds an option by its full key; a preset sets it in every command that
has this option. The values are those of measurements ("Trade-off" in docs/measurements.md). Experiments and the command
line go over presets.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from gsencoder.app.settings.options import options_by_key
from gsencoder.core.settings import shown_value

Preset = Literal["fast", "balanced", "exact"]
PRESET = "preset"
DEFAULT_PRESET: Preset = "balanced"
PRESETS: tuple[str, ...] = get_args(Preset)


@dataclass(frozen=True, slots=True, kw_only=True)
class PresetOption:
    """An option that presets set; None = its default.

    Attributes:
        key: of the option.
        fast: its value where time counts.
        exact: its value where accuracy counts.
    """

    key: str
    fast: Any = None
    exact: Any = None


PRESET_OPTIONS = (
    PresetOption(key="fusion.view_share", fast=0.5),
    PresetOption(key="fusion.blend.rays_per_patch", exact=196),
    PresetOption(key="fusion.blend.stop_transmittance", fast=0.1, exact=1e-6),
    PresetOption(key="fusion.energy", exact=1.0),
    PresetOption(key="fusion.table_energy", exact=1.0),
    PresetOption(key="fusion.max_rank", exact=0),
    PresetOption(key="prepare.fusion.blend.rays_per_patch", exact=196),
    PresetOption(key="prepare.fusion.blend.stop_transmittance", exact=1e-6),
    PresetOption(key="encode.precision", exact="float32"),
    PresetOption(key="encode.halo", fast=0.0, exact=1.28),
    PresetOption(key="choose.candidates", fast=16, exact=64),
    PresetOption(key="budget.minutes", fast=5.0, exact=0.0),
    PresetOption(key="optimize.steps", exact=3000),
)


def preset_values(cls: type, preset: str) -> dict[str, Any]:
    """What a preset sets in a command, by full key.

    Args:
        cls: the settings class of the command.
        preset: its name.
    """
    options = options_by_key(cls)
    values = {each.key: getattr(each, preset, None) for each in PRESET_OPTIONS}
    return {key: value for key, value in values.items() if value is not None and key in options}


def preset_node(cls: type, preset: str) -> dict[str, Any]:
    """The same as nested settings."""
    node: dict[str, Any] = {}
    for key, value in preset_values(cls, preset).items():
        *sections, name = key.split(".")
        inner = node
        for section in sections:
            inner = inner.setdefault(section, {})
        inner[name] = value
    return node


def describe_presets(cls: type) -> Mapping[str, str]:
    """What each preset changes in a command, in words."""
    described: dict[str, str] = {}
    for preset in PRESETS:
        values = preset_values(cls, preset)
        changes = ", ".join(f"{key}={shown_value(value)}" for key, value in values.items())
        described[preset] = "the defaults" if preset == DEFAULT_PRESET else changes or "changes nothing in this command"
    return described
