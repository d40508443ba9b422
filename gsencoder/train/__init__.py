"""Training: prepared scenes, samples, losses, and the loop over them."""

from gsencoder.train.run import TrainConfig, Training, train

__all__ = ["TrainConfig", "Training", "train"]
