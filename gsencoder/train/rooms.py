"""Furnished rooms as training samples: splats with labels and without photographs, made while a training runs, so that
no two samples are alike.

Room g of slot s of a run comes from (seed, s, g), and sample k from slot k mod S, where S is a multiple of the number
of samples of a step: a process, or a data worker of it, makes the rooms of its own slots alone.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float16, Float32, Float64, Int32

from gsencoder.data.furnished.library import Model, load_libraries, select_makes
from gsencoder.data.furnished.plan import plan_home
from gsencoder.data.furnished.walk import LabeledSplat, furnished_splat, splat_walk
from gsencoder.train.prepared import ScenePart, ViewRows
from gsencoder.train.samples import Codes, RoomsConfig, SamplingConfig, TrainingScene
from gsencoder.types import Cameras, Gaussians

SLOTS = 160
"""Smallest number of rooms from which samples are drawn in turn. A network that meets the same few dozen rooms for a
hundred steps learns these by heart, and nothing of things elsewhere."""
STORED = 0.5
"""Share of storage rooms, in which things of all kinds are as frequent, among homes."""
NOISE, DRIFT = (0.3, 2.0), 0.03
"""Smallest and largest noise of the sensor, as in `WalkConfig`, and largest drift, metres: from clean meshes to seeds
of a first depth camera's frames, whose floors are 1 cm thick (rms in balls of 10 cm)."""
MADE = 0.5
"""Share of makes of our own, of kinds of which there are such: from ten doors of a library no others are learned."""
LEAST_WALKED = 0.25
"""Smallest part of a walk: people scan a part of a room."""
DENSITIES, FINEST = (0.4, 1.1), 0.015
"""Smallest and largest distance of the seeds, in voxels of the encoder, and the smallest one in metres."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabeledPart(ScenePart):
    """A splat with labels as the part of a training scene that a coded teacher has; see `ScenePart`."""

    name: str
    splat: LabeledSplat
    codes_of_rows: Int32[np.ndarray, " N"]
    codebook: Float32[np.ndarray, "C channels"]
    voxel: float
    path: Path = Path()
    metres_per_unit: float | None = 1.0

    def __len__(self) -> int:
        return len(self.splat.means)

    @property
    def means(self) -> Float32[np.ndarray, "N 3"]:
        return self.splat.means

    @property
    def cameras(self) -> Cameras:
        return self.splat.cameras

    @property
    def weights(self) -> Float32[np.ndarray, " N"]:
        return np.ones(len(self), np.float32)

    @property
    def view_names(self) -> tuple[str, ...]:
        return tuple(f"view {view}" for view in range(len(self.cameras)))

    @property
    def up(self) -> Float64[np.ndarray, "3"]:
        return np.array([0.0, 0.0, 1.0])

    def gaussians(self, rows: np.ndarray) -> Gaussians:
        return self.splat.gaussians(rows)

    def codes(self, codebook: Float32[np.ndarray, "C channels"]) -> Int32[np.ndarray, " N"]:  # noqa: ARG002
        return self.codes_of_rows

    def targets(self, rows: np.ndarray) -> Float32[np.ndarray, "n channels"]:
        return self.codebook[self.codes_of_rows[rows]]

    def float16_targets(self, rows: np.ndarray) -> Float16[np.ndarray, "n channels"]:
        return self.targets(rows).astype(np.float16)

    def view(self, view: int) -> ViewRows:  # noqa: ARG002
        """No rows: there is no photograph."""
        none = np.zeros(0, np.float32)
        return ViewRows(
            crow=np.zeros(1, np.int64),
            col=none.astype(np.int32),
            weight=none,
            targets=none.reshape(0, self.codebook.shape[1]),
            valid=none.astype(bool),
        )

    def close(self) -> None:
        """Nothing is open."""


def models_of(config: RoomsConfig) -> tuple[Model, ...]:
    """The models of the libraries that may stand in rooms."""
    models = select_makes(load_libraries(config.libraries), "train")
    return tuple(model for model in models if model.kind.name not in config.without)


class RoomStream:
    """The rooms of a training by the number of the sample; those of the slots in use are kept."""

    def __init__(
        self,
        config: RoomsConfig,
        codebook: Float32[np.ndarray, "C channels"],
        code_of: Mapping[str, int],
        sampling: SamplingConfig = SamplingConfig(),
        *,
        voxel: float,
        teachers: int = 1,
        teacher: int = 0,
        step_samples: int = 1,
        seed: int = 0,
    ) -> None:
        """Reads the libraries' catalogues.

        Args:
            codebook, code_of: vectors of the labels in standard units, and the row of each kind.
            sampling: how much coarser than the encoder's the cells of a room may be.
            voxel: edge of the encoder's cells, metres.
            teachers, teacher: the number of teachers of the training, and which of them has the labels.
            step_samples: samples of a step over all processes.
        """
        self.config, self.share = config, config.share
        self._models = models_of(config)
        self._codebook, self._code_of, self._seed = codebook, code_of, seed
        self._sampling, self._voxel = sampling, voxel
        self._teachers, self._teacher = teachers, teacher
        # An even number of steps, so that two data workers have slots of their own.
        self.slots = step_samples * 2 * -(-SLOTS // (2 * step_samples))
        self._rooms: dict[int, tuple[int, TrainingScene]] = {}

    def scene(self, number: int) -> tuple[TrainingScene, Codes]:
        """The room of a sample, and the classes of its Gaussians."""
        slot, visit = number % self.slots, number // self.slots
        # Rooms of different slots are replaced at different times.
        generation = (visit + slot * self.config.samples // self.slots) // self.config.samples
        if slot not in self._rooms or self._rooms[slot][0] != generation:
            self._rooms[slot] = generation, self._make(slot, generation)
        scene = self._rooms[slot][1]
        return scene, tuple(None if part is None else part.codes(self._codebook) for part in scene.parts)

    def _make(self, slot: int, generation: int) -> TrainingScene:
        rng = np.random.default_rng([self._seed, 4, slot, generation])
        part = self.labeled_part(rng, f"room {slot}.{generation}")
        return TrainingScene([part if number == self._teacher else None for number in range(self._teachers)])

    def labeled_part(self, rng: np.random.Generator, name: str) -> LabeledPart:
        """Makes a room, seen on a walk with a sensor of random quality, with seeds of random density."""
        home = plan_home(self._models, rng, ("storage room",) if rng.random() < STORED else (), made=MADE)
        noise = NOISE[0] * (NOISE[1] / NOISE[0]) ** rng.random()
        walk = splat_walk(home, noise=noise, drift=float(rng.uniform(0, DRIFT)))
        voxel = self._sampling.draw_voxel(self._voxel, rng)
        spacing = DENSITIES[0] * (DENSITIES[1] / DENSITIES[0]) ** rng.random() * voxel
        walked = float(rng.uniform(LEAST_WALKED, 1))
        splat = furnished_splat(home, walk, max(FINEST, spacing), rng, walked=walked)
        of_items = np.array([self._code_of[item.kind] for item in home.items], np.int32)
        return LabeledPart(
            name=name, splat=splat, codes_of_rows=of_items[splat.items], codebook=self._codebook, voxel=voxel
        )
