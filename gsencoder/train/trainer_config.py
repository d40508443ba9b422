"""Settings of the training loop, and the learning rate of each step."""

import math
from dataclasses import dataclass, field

from gsencoder.core.errors import InputError
from gsencoder.core.process import Precision

CHANGEABLE_ON_RESUME = (
    "workers",
    "prefetch",
    "log_every",
    "validate_every",
    "checkpoint_every",
    "compile",
    "accumulate",
)
"""Settings of the loop that a resumed run may change, since they do not change the result of a step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainerConfig:
    """Settings of the training loop."""

    steps: int = field(default=2000, metadata={"help": "optimizer steps"})
    batch: int = field(default=1, metadata={"help": "samples per micro-batch"})
    accumulate: int = field(
        default=1, metadata={"help": "micro-batches per process and step, whose gradients are accumulated"}
    )
    learning_rate: float = field(default=2e-3, metadata={"help": "highest learning rate"})
    final_rate: float = field(default=0.01, metadata={"help": "learning rate at the end, as a fraction of the highest"})
    warmup: int = field(default=100, metadata={"help": "steps of linear warm-up of the learning rate"})
    weight_decay: float = field(default=0.05, metadata={"help": "weight decay of matrices; norms and biases have none"})
    clip: float = field(default=1.0, metadata={"help": "norm to which the gradient is clipped; 0 = no clipping"})
    precision: Precision = field(
        default="auto",
        metadata={
            "help": "floating-point type of the network; auto = bfloat16 on a CPU with AMX, else float32 (on a GPU "
            "bfloat16 suits model=base)"
        },
    )
    workers: int | None = field(
        default=None,
        metadata={
            "help": "number of processes that make samples; 0 = make them in the training process, null = that "
            "without a GPU, else one a core, at most 8, as far as /dev/shm has 1 GiB for each"
        },
    )
    prefetch: int = field(
        default=2,
        metadata={"help": "batches that each of these processes makes ahead; each is held in shared memory (/dev/shm)"},
    )
    seed: int = field(default=0, metadata={"help": "seed of all random numbers"})
    log_every: int = field(default=10, metadata={"help": "steps per row of the log, over which losses are averaged"})
    validate_every: int = field(default=500, metadata={"help": "steps between validations; 0 = only at the end"})
    checkpoint_every: float = field(default=300.0, metadata={"help": "seconds between checkpoints"})
    compile: bool = field(default=False, metadata={"help": "compile the network with torch.compile"})

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "accumulate", "log_every", "prefetch"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected 1 or more, got {getattr(self, name)}")
        for name in ("warmup", "weight_decay", "clip", "workers", "seed", "validate_every", "checkpoint_every"):
            if not 0 <= (getattr(self, name) or 0) < math.inf:
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")
        if self.seed >= 1 << 63:
            raise InputError(f"seed: expected a number below 2⁶³, got {self.seed}")
        if not 0 < self.learning_rate < math.inf:
            raise InputError(f"learning_rate: expected a positive number, got {self.learning_rate}")
        if not 0 <= self.final_rate <= 1:
            raise InputError(f"final_rate: expected a number in [0, 1], got {self.final_rate}")

    def samples_per_step(self, processes: int) -> int:
        """The number of samples of one optimizer step over all processes."""
        return self.batch * self.accumulate * processes

    def rate_at(self, step: int) -> float:
        """The learning rate of a step: linear warm-up, then a half cosine down to `final_rate`."""
        if step < self.warmup:
            return self.learning_rate * (step + 1) / self.warmup
        progress = (step - self.warmup) / max(self.steps - self.warmup, 1)
        final = self.final_rate
        return self.learning_rate * (final + (1 - final) * 0.5 * (1 + math.cos(math.pi * progress)))
