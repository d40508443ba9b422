"""Samples of several teachers: whose classes choose the centers, and whose heads are in which term."""

import numpy as np
import pytest
import torch
from joint_training import Datasets, batch_of, joint
from training_scenes import LOSSES, small_encoder

from gsencoder.train import samples as module
from gsencoder.train.losses import AdapterHead, render_loss
from gsencoder.train.run import Distillation
from gsencoder.train.samples import SampleDataset, TrainingScene


def test_heads_of_a_teacher_are_in_its_render_loss_and_in_no_other_term(datasets: Datasets) -> None:
    data = joint(datasets)
    batch = batch_of(data, range(3))
    predicted = torch.randn(len(batch.attributes), 8)
    torch.manual_seed(5)
    heads = [(AdapterHead(torch.nn.Linear(4, 3), torch.zeros(3), 1.0), torch.nn.Identity())]
    plain = Distillation(small_encoder(8), LOSSES, data.recipe.teachers).terms(predicted, batch)
    for number, name in enumerate(datasets):
        terms = Distillation(small_encoder(8), LOSSES, data.recipe.teachers, heads={name: heads}).terms(
            predicted, batch
        )
        rows, own = batch.teachers[number].rows, predicted.split([4, 4], dim=1)[number]
        expected = render_loss(own, rows.blend(len(own)), rows.targets, rows.row_weights, LOSSES, heads)
        torch.testing.assert_close(terms[f"{name}/render"], expected)
        assert not torch.isclose(terms[f"{name}/render"], plain[f"{name}/render"])
        for term in set(plain) - {f"{name}/render"}:
            torch.testing.assert_close(terms[term], plain[term])


def test_centers_are_drawn_by_the_classes_of_the_first_teacher_that_a_scene_has(
    datasets: Datasets, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = joint(datasets)
    given: list[np.ndarray] = []

    def choose(means: np.ndarray, cameras: object, weights: np.ndarray, *others: object) -> object:
        given.append(weights)
        return chosen(means, cameras, weights, *others)  # type: ignore[arg-type]

    chosen = module.choose_crop
    monkeypatch.setattr(module, "choose_crop", choose)
    for parts, number in (((0, 1), 0), ((None, 1), 1), ((0, None), 0)):
        scene = data.scenes[0]
        having = TrainingScene([None if part is None else scene.parts[part] for part in parts])
        SampleDataset([having], data.recipe).make(0)
        own, balance = scene.parts[number], data.recipe.teachers[number].class_balance
        expected = np.zeros(len(own))
        seen = np.flatnonzero(own.weights)
        expected[seen] = balance.target_weights(own.targets(seen), 1.0)
        np.testing.assert_allclose(given.pop(), expected, rtol=1e-5)
