"""An encoder with several teachers: what each of them contributes is what it contributes alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from joint_training import Datasets, batch_of, joint
from training_scenes import LOSSES, SHORT, samples, small_encoder

from gsencoder.core.logs import LOG_FILE, read_log
from gsencoder.core.settings import first_difference
from gsencoder.teachers.labels import PaletteConfig
from gsencoder.train.run import Distillation, TrainConfig, encoder_trainer, resume_settings
from gsencoder.train.samples import SampleDataset


def test_terms_and_gradients_of_each_teacher_are_those_of_a_training_with_it_alone(datasets: Datasets) -> None:
    data = joint(datasets)
    batch = batch_of(data, range(6))
    widths = [teacher.channels for teacher in data.recipe.teachers]
    predicted = torch.randn(len(batch.attributes), sum(widths), requires_grad=True)
    both = Distillation(small_encoder(), LOSSES, data.recipe.teachers)
    terms, divisors = both.terms(predicted, batch), both.divisors(batch)
    sum(terms[name] for name in terms).backward()
    assert predicted.grad is not None
    for number, (name, (dataset, names)) in enumerate(datasets.items()):
        alone = Distillation(small_encoder(), LOSSES, data.recipe.teachers[number : number + 1])
        own = batch._replace(teachers=batch.teachers[number : number + 1])
        part = predicted.detach().split(widths, dim=1)[number].clone().requires_grad_()
        expected = alone.terms(part, own)
        sum(expected.values()).backward()
        assert set(expected) == {"field", "render", "contrast"}
        for term, value in expected.items():
            torch.testing.assert_close(terms[f"{name}/{term}"], value)
            assert divisors[f"{name}/{term}"] == alone.divisors(own)[term]
        assert divisors[f"{name}/render"] == pytest.approx(own.teachers[0].rows.row_weights.sum().item(), rel=1e-6)
        assert divisors[f"{name}/field"] == pytest.approx(own.teachers[0].loss_weights.sum().item(), rel=1e-6)
        torch.testing.assert_close(predicted.grad.split(widths, dim=1)[number], part.grad)
        del dataset, names


def test_samples_have_the_targets_of_each_teacher_for_the_same_gaussians(datasets: Datasets) -> None:
    data = joint(datasets)
    for number, (name, (dataset, names)) in enumerate(datasets.items()):
        # A teacher alone draws other centers, by its own classes, unless all Gaussians are in each sample.
        everything = {"sampling": replace(data.recipe.sampling, scope="scene", gaussians=0)}
        together = SampleDataset(data.scenes[:2], replace(data.recipe, **everything))
        alone = samples(dataset, names[:2], **everything)
        assert together[0].name == alone[0].name
        theirs, (ours,) = together[0].teachers[number], alone[0].teachers
        torch.testing.assert_close(theirs.targets, ours.targets)
        torch.testing.assert_close(theirs.loss_weights, ours.loss_weights)
        torch.testing.assert_close(theirs.codes, ours.codes)
        for one, other in zip(theirs.rows, ours.rows, strict=True):
            torch.testing.assert_close(one, other)
        assert name in datasets


def test_a_scene_that_lacks_a_teacher_has_no_weight_in_its_terms(datasets: Datasets) -> None:
    data = joint(datasets)
    lacking = SampleDataset(data.scenes[2:], data.recipe)
    batch = batch_of(lacking, range(2))
    distillation = Distillation(small_encoder(), LOSSES, data.recipe.teachers)
    divisors = distillation.divisors(batch)
    assert divisors["heights/field"] == divisors["heights/render"] == divisors["heights/contrast"] == 0
    assert (batch.teachers[1].codes == -1).all()
    predicted = torch.randn(len(batch.attributes), 8, requires_grad=True)
    terms = distillation.terms(predicted, batch)
    sum(terms.values()).backward()
    assert predicted.grad is not None
    assert terms["heights/field"].item() == terms["heights/render"].item() == terms["heights/contrast"].item() == 0
    assert (predicted.grad[:, 4:] == 0).all()
    assert (predicted.grad[:, :4] != 0).any()


def test_the_log_averages_a_teachers_losses_over_the_steps_that_have_it(datasets: Datasets, tmp_path: Path) -> None:
    config = replace(SHORT, steps=6, log_every=3)
    data = joint(datasets)
    each = encoder_trainer(
        small_encoder(8), data, LOSSES, replace(config, log_every=1), folder=_made(tmp_path / "1"), settings={}
    )
    each.run()
    single = read_log(tmp_path / "1" / LOG_FILE)
    lacking = [row for row in single if not row.get("heights/field")]
    assert len(lacking) == 2  # One wall of three.
    encoder_trainer(small_encoder(8), data, LOSSES, config, folder=_made(tmp_path / "3"), settings={}).run()
    rows = read_log(tmp_path / "3" / LOG_FILE)
    assert len(rows) == 2
    for row, group in zip(rows, (single[:3], single[3:]), strict=True):
        for name in ("heights/field", "sides/render", "loss"):
            values = [float(one[name]) for one in group if one.get(name)]
            assert float(row[name]) == pytest.approx(np.mean(values), rel=1e-5)


def test_a_resumed_run_has_the_same_bits(datasets: Datasets, tmp_path: Path) -> None:
    def run(folder: Path, steps: range | None = None) -> torch.Tensor:
        encoder = small_encoder(8)
        trainer = encoder_trainer(encoder, joint(datasets), LOSSES, SHORT, folder=folder, settings={"run": 1})
        if steps is None:
            trainer.run()
        else:
            with pytest.raises(KeyboardInterrupt):
                trainer.run(_stop_at(4))
        return encoder.head_norm.weight.detach().clone()

    straight = run(_made(tmp_path / "straight"))
    run(_made(tmp_path / "killed"), range(4))
    assert torch.equal(run(tmp_path / "killed"), straight)


def test_training_lowers_the_losses_of_both_teachers(datasets: Datasets, tmp_path: Path) -> None:
    data, encoder = joint(datasets), small_encoder(8)
    batch = batch_of(data, range(6))

    def field_losses() -> dict[str, float]:
        distillation = Distillation(encoder.eval(), LOSSES, data.recipe.teachers)
        with torch.no_grad():
            terms, divisors = distillation(batch), distillation.divisors(batch)
        return {name: terms[name].item() / divisors[name] for name in ("sides/field", "heights/field")}

    before = field_losses()
    encoder_trainer(encoder, data, LOSSES, replace(SHORT, steps=25), folder=tmp_path, settings={}).run()
    after = field_losses()
    for name, loss in before.items():
        assert after[name] < 0.8 * loss, name


def test_the_weight_of_a_teacher_multiplies_that_of_each_of_its_terms(datasets: Datasets) -> None:
    lambdas = Distillation(small_encoder(8), LOSSES, joint(datasets, {"heights": 0.25}).recipe.teachers).lambdas
    for term, weight in (("field", 1.0), ("render", LOSSES.render_weight), ("contrast", LOSSES.contrast_weight)):
        assert lambdas[f"sides/{term}"] == weight
        assert lambdas[f"heights/{term}"] == 0.25 * weight


def test_a_teacher_without_contrast_has_no_such_term(datasets: Datasets) -> None:
    data = joint(datasets)
    sides, heights = data.recipe.teachers
    distillation = Distillation(small_encoder(8), LOSSES, (sides, replace(heights, classes=False)))
    batch = batch_of(data, range(2))
    terms = distillation.terms(torch.randn(len(batch.attributes), 8), batch)
    assert set(terms) == set(distillation.lambdas)
    assert "sides/contrast" in terms
    assert "heights/contrast" not in terms


def test_a_teacher_of_weight_zero_changes_nothing_but_its_own_columns(datasets: Datasets, tmp_path: Path) -> None:
    weightless = joint(datasets, {"heights": 0.0})
    names = Distillation(small_encoder(8), LOSSES, weightless.recipe.teachers).lambdas
    assert all(name.startswith("sides/") for name in names)
    encoder = small_encoder([4, 4])
    own = encoder.head.of_teacher[1]  # type: ignore[index, union-attr]
    before = [parameter.detach().clone() for parameter in own.parameters()]
    config = replace(SHORT, steps=2)
    encoder_trainer(encoder, weightless, LOSSES, config, folder=tmp_path, settings={}, weight_decay=0.0).run()
    assert all(torch.equal(old, new) for old, new in zip(before, own.parameters(), strict=True))


def test_a_run_goes_on_only_with_its_teachers_in_their_order(datasets: Datasets) -> None:
    config = TrainConfig(teachers={"sides": PaletteConfig(), "heights": PaletteConfig()})
    opened = {name: dataset for name, (dataset, _) in datasets.items()}
    turned = {name: opened[name] for name in reversed(opened)}
    first, second = (resume_settings(config, each, ["wall_0"], "") for each in (opened, turned))
    assert first != second
    assert first_difference(first, second).startswith("teachers=['sides', 'heights'], and this run asks teachers=['hei")
    assert first != resume_settings(config, opened, ["wall_0", "wall_1"], "")


def _stop_at(step: int) -> object:
    def track(steps: range, label: str) -> object:
        for number in steps:
            if number == step:
                raise KeyboardInterrupt
            yield number

    return track


def _made(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    return folder
