"""What trades cost for accuracy in fusion and in packages."""

from dataclasses import dataclass, field

from gsencoder.core.errors import InputError
from gsencoder.core.settings import Knob
from gsencoder.fusion.store.package import Form

FUSION_KNOBS = (
    Knob(name="view_share", key="view_share", values=(0.17, 0.33, 0.5, 0.67), exact=1.0),
    Knob(name="views", key="views", values=(4, 8, 16), exact=0),
    Knob(name="view_choice", key="view_choice", values=("coverage",), needs={"view_share": 0.5}),
    Knob(name="rays_per_patch", key="blend.rays_per_patch", values=(1, 4, 9, 16, 36), exact=196),
    Knob(name="min_weight", key="blend.min_weight", values=(1e-4, 1e-3, 1e-2), exact=0.0),
    Knob(name="stop_transmittance", key="blend.stop_transmittance", values=(1e-3, 1e-2, 0.1), exact=1e-6),
    Knob(name="tolerance", key="visibility.relative", values=(0.005, 0.01, 0.05, 0.1)),
    Knob(name="energy", key="energy", values=(0.95, 0.99, 0.995)),
    Knob(name="table_energy", key="table_energy", values=(0.9, 0.99, 0.999)),
    Knob(name="max_rank", key="max_rank", values=(8, 16, 32, 64)),
    Knob(name="basis", key="basis", values=(False,), exact=False),
)
"""Knobs of `gsencoder.fusion.fuse.FuseConfig`. A tolerance of visibility has no exact value: a wider one takes in what
is hidden, and a narrower one leaves out what is seen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PackageSettings:
    """How features are packed."""

    form: Form = field(default="compact", metadata={"help": "see `pack form=`"})
    error: float = field(default=0.01, metadata={"help": "largest mean loss of centered cosine, for form=compact"})
    threshold: float = field(default=0.9, metadata={"help": "centered cosine that the rows of form=index reach"})

    def __post_init__(self) -> None:
        if not 0 < self.error < 1:
            raise InputError(f"error: expected a budget between 0 and 1, got {self.error}")


PACKAGE_KNOBS = (
    Knob(name="form", key="form", values=("index", "npz")),
    Knob(name="error", key="error", values=(0.001, 0.003, 0.03, 0.1), exact=0.001),
    Knob(name="threshold", key="threshold", values=(0.8, 0.95, 0.98), needs={"form": "index"}),
)
