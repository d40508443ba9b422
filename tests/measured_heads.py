"""Small adapter heads, as they are measured."""

import numpy as np
import torch
from torch import nn

from gsencoder.fusion.measured_heads import MeasuredHead
from gsencoder.teachers.heads import Head, Residual
from gsencoder.types import FeatureSpace

SPACE = FeatureSpace(name="radio", channels=6, teacher="radio", weights="abcd", preprocessing="resized")


def body(channels: int = 4) -> nn.Sequential:
    torch.manual_seed(channels)
    block = Residual(nn.LayerNorm(8), nn.GELU(), nn.Linear(8, 8))
    layers = nn.Sequential(nn.Linear(6, 8), block, nn.LayerNorm(8), nn.ReLU(), nn.Linear(8, channels))
    for parameter in layers.parameters():
        nn.init.normal_(parameter)
    return layers


def measured(name: str = "siglip.summary", channels: int = 4, text: str = "siglip") -> MeasuredHead:
    mean = np.arange(channels, dtype=np.float32)
    head = Head(name=name, body=body(channels), text=text, model="M")
    return MeasuredHead(head=head, mean=mean, scale=2.0, cells=3, cosine=0.5, worst=0.25)
