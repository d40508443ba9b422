"""What trades cost for accuracy in reconstruction."""

from dataclasses import dataclass, field

from gsencoder.core.settings import Knob
from gsencoder.data.scenes import SceneConfig
from gsencoder.reconstruct.plan import BudgetConfig
from gsencoder.reconstruct.run import ReconstructConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructionSettings:
    """How photographs are read and become Gaussians. The budget of minutes is off: it would choose steps and sizes."""

    data: SceneConfig = field(default_factory=SceneConfig)
    reconstruct: ReconstructConfig = field(
        default_factory=lambda: ReconstructConfig(budget=BudgetConfig(minutes=0.0), validate_every=0)
    )


RECONSTRUCTION_KNOBS = (
    Knob(name="steps", key="reconstruct.optimize.steps", values=(200, 400, 800)),
    Knob(name="voxel", key="reconstruct.seeds.voxel", values=(0.015, 0.03, 0.04)),
    Knob(name="image_scale", key="data.image_scale", values=(0.35, 0.5, 0.7)),
    Knob(name="sh_degree", key="reconstruct.optimize.sh_degree", values=(0, 1)),
)
"""Knobs of `ReconstructionSettings`; none has an exact value, since more steps and Gaussians can also fit noise."""
