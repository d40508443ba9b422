"""The referring protocol: boxes of what sentences describe (ScanRefer; SplatDistill sec. 4.5, table 5).

A sentence is answered by the boxes of the words that the text table knows in it, the first of them first, or of the
whole sentence where a text tower can embed it. Without a file of sentences, the names of the scene's objects are asked,
one sentence an object.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.evaluate.scores.referring import PredictedBoxes, ReferredObject, several_of_their_class
from gsencoder.infer.ask.question_words import words_in
from gsencoder.infer.localize.localize import LocalizeConfig, localize
from gsencoder.text.build import Words, closed_table
from gsencoder.types import GaussianFeatures, Localization, Scene

CANDIDATES = 10
"""Boxes that are predicted for each sentence."""
