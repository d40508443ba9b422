"""Options of a short training."""

QUICK = (
    "quiet=true",
    "train.steps=6",
    "train.warmup=2",
    "train.log_every=2",
    "sampling.gaussians=600",
    "sampling.smallest=200",
    "model.transformer.encoder_channels=[32,32,32,32,32]",
    "model.transformer.decoder_channels=[32,32,32,32]",
)
