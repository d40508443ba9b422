"""Teachers: models that give each view a map of features. One file each; all follow the protocol below."""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.types import FeatureMap, FeatureSpace, Views


class MissingInput(InputError):
    """A scene does not have what a teacher needs of every scene, such as labels. A training with several teachers
    leaves the teacher out in such a scene."""


@runtime_checkable
class Teacher(Protocol):
    """Turns one view into a feature map.

    Attributes:
        space: what its vectors are.
        table: the vectors that all its maps are codes into or shares of; None where maps are dense or each has its own
            table.
        mean: the space's mean, where it is known without looking at the scene.
        needs_images: whether it looks at photographs (a splat without views is then rendered for it).
        cheap: whether making a map twice costs less than keeping it on disk.
    """

    @property
    def space(self) -> FeatureSpace: ...

    @property
    def table(self) -> Float32[np.ndarray, "C D"] | None: ...

    @property
    def mean(self) -> Float32[np.ndarray, " D"] | None: ...

    @property
    def needs_images(self) -> bool: ...

    @property
    def cheap(self) -> bool: ...

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """The features of one view. What calls it (`gsencoder.fusion.checkpoint.upright`) gives upright views."""
        ...

    def settings(self) -> dict[str, Any]:
        """Everything that changes its output, as JSON values: stored beside the features, compared on resuming."""
        ...
