"""The grounding protocol: which pairs it has, what is rendered where, and what the command writes."""

import json
from dataclasses import replace
from shutil import copytree

import numpy as np
import pytest
import torch
from command_runs import results_of
from memory_samples import make_bank, memory_of_features
from named_rooms import write_words
from rooms import room

from gsencoder.app import main as cli
from gsencoder.core.errors import InputError
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.evaluate.benchmarks.grounding import GroundingProtocol, ground_scene, ids_by_name, masks_of
from gsencoder.evaluate.benchmarks.protocol import Evaluation, predict_scenes
from gsencoder.render import blend
from gsencoder.text.table import make_text_table
from gsencoder.types import FeatureSpace, GaussianFeatures, Scene, SceneObject, Views


def thing(number: int, name: str | None, *, placed: bool = True) -> SceneObject:
    return SceneObject(id=number, name=name, aabb_min=np.zeros(3), aabb_max=np.ones(3), placed=placed)


def test_instances_of_one_name_are_one_mask_and_small_ones_are_counted() -> None:
    objects = [thing(1, "mug"), thing(2, "mug"), thing(3, "desk", placed=False), thing(4, None), thing(5, "fork")]
    assert ids_by_name(objects) == {"desk": [3], "fork": [5], "mug": [1, 2]}
    instances = np.array([[1, 1, 2, 0], [3, 3, 3, 4], [3, 3, 0, 4]], np.int32)
    masks, small = masks_of(instances, ids_by_name(objects), 3)
    # The fork is not in the view at all.
    assert (list(masks), small) == (["desk", "mug"], 0)
    assert np.array_equal(masks["mug"], np.isin(instances, [1, 2]))
    masks, small = masks_of(instances, ids_by_name(objects), 4)
    assert (list(masks), small) == (["desk"], 1)


def labeled_room() -> tuple[Scene, GaussianFeatures]:
    """A room in which the cube is a mug; features are the words, exactly."""
    scene, cube = room()
    which = torch.zeros(len(scene.gaussians))
    which[cube] = 1
    cameras = scene.views.cameras
    instances = []
    for view in range(len(cameras)):
        blended = blend(scene.gaussians, cameras, view)
        instances.append((blended.render(which) > 0.5).reshape(blended.shape).numpy().astype(np.int32))
    words = np.eye(2, dtype=np.float32)
    space = FeatureSpace(name="s", channels=2, text_encoder="words")
    features = GaussianFeatures(
        features=words[which.long().numpy()], weights=np.ones(len(which), np.float32),
        mean=np.full(2, 0.5, np.float32), space=space,
    )  # fmt: skip
    views = Views(cameras=cameras, names=scene.views.names, instances=instances)
    return replace(scene, views=views, objects=(thing(1, "mug"),)), features


WORDS = make_text_table(["wall", "mug"], np.eye(2, dtype=np.float32), "words")


def test_what_features_say_exactly_is_grounded_exactly() -> None:
    scene, features = labeled_room()
    pairs, small, _ = ground_scene(scene, features, WORDS, GroundingProtocol(min_pixels=5))
    assert len(pairs) + small == len(scene.views)
    assert [pair.view for pair in pairs] == [name for name in scene.views.names if name in {p.view for p in pairs}]
    assert min(pair.iou for pair in pairs) > 0.8
    swapped = replace(features, features=features.features[:, ::-1].copy())
    assert max(pair.iou for pair in ground_scene(scene, swapped, WORDS, GroundingProtocol(min_pixels=5))[0]) < 0.1


def test_a_memory_is_grounded_by_what_pixels_attend_to_and_rays_that_meet_nothing_answer_no_word() -> None:
    scene, features = labeled_room()
    memory = memory_of_features(features, make_bank(np.eye(2), features.mean, features.space), channels=1)
    protocol = GroundingProtocol(min_pixels=5)
    plain, attended = (ground_scene(scene, features, WORDS, protocol, memory=each)[0] for each in (None, memory))
    assert [(a.view, a.phrase) for a in plain] == [(b.view, b.phrase) for b in attended]
    assert min(pair.iou for pair in attended) > 0.8
    # The queries of the other word: the features that are passed beside the memory do not answer.
    other = replace(memory, queries=-memory.queries)
    assert max(pair.iou for pair in ground_scene(scene, features, WORDS, protocol, memory=other)[0]) < 0.1
    # Only the cube has features, so that every pixel that it reaches at all answers, and all others are 0.
    alone = replace(features, weights=features.features[:, 1].copy())
    pairs, *_ = ground_scene(scene, alone, WORDS, protocol)
    assert all(pair.finite for pair in pairs)
    assert min(pair.iou for pair in pairs) > 0.7


def test_scenes_without_labels_and_words_of_other_spaces_are_refused() -> None:
    scene, features = labeled_room()

    def source(_: Scene) -> tuple[GaussianFeatures, dict[str, float]]:
        return features, {}

    benchmark = GroundingProtocol(min_pixels=5).start(Evaluation(words=WORDS))
    (result,) = predict_scenes(benchmark, [(scene, 0.5)], source)
    assert result.seconds["load"] == 0.5
    assert result.gaussians == len(features)
    for bad in (replace(scene, objects=()), replace(scene, views=None)):
        with pytest.raises(InputError, match="needs views with instance maps"):
            predict_scenes(benchmark, [(bad, 0.0)], source)
    large = GroundingProtocol(min_pixels=100000).start(Evaluation(words=WORDS))
    results = predict_scenes(large, [(scene, 0.0)], source)
    with pytest.raises(InputError, match="no view that shows a named object with 100000 pixels in 1 scene"):
        large.report(results)
    other = make_text_table(["wall", "mug"], np.eye(2, dtype=np.float32), "others")
    with pytest.raises(InputError, match="use the text encoder 'words'"):
        ground_scene(scene, features, other)


@pytest.mark.slow
def test_the_command_writes_pairs_and_names_and_takes_features_of_folders(tmp_path, capsys):
    made = make_room(0, objects=4, views=4, width=120, height=90)
    write_room(made, tmp_path / "room_0")
    write_words(tmp_path / "words.safetensors", made)
    scene, teacher = str(tmp_path / "room_0"), f"teacher.words={tmp_path / 'words.safetensors'}"
    ask = ["evaluate", scene, "protocol=grounding", "protocol.min_pixels=10"]
    assert cli.main([*ask, teacher, f"out={tmp_path / 'fused'}"]) == 0
    assert "pairs of a view and a name in 1 scene: mIoU" in " ".join(capsys.readouterr().out.split())
    fused = results_of(tmp_path / "fused")
    pairs = (tmp_path / "fused" / "pairs.csv").read_text().splitlines()
    assert len(pairs) == 1 + fused["pairs"]
    assert sum(row["pairs"] for row in fused["names"].values()) == fused["pairs"] > 0
    # Each name counts the same, the worst first.
    of_names = [row["miou"] for row in fused["names"].values()]
    assert of_names == sorted(of_names)
    assert fused["miou_names"] == pytest.approx(np.mean(of_names))
    assert fused["scenes"][0]["small"] == fused["small"]
    assert fused["miou"] > 0.5
    assert 0 <= fused["p60"] <= fused["p50"] <= 1
    # What was written by fuse is what evaluate makes itself, but for the rounding of the file.
    folders = tmp_path / "features"
    assert cli.main(["fuse", scene, teacher, f"out={folders / 'room_0'}", "quiet=true"]) == 0
    for number, folder in enumerate((folders, folders / "room_0")):
        out = tmp_path / f"stored {number}"
        assert cli.main([*ask, f"features={folder}", f"out={out}", "quiet=true"]) == 0
        stored = results_of(out)
        assert stored["pairs"] == fused["pairs"]
        assert stored["miou"] == pytest.approx(fused["miou"], abs=0.01)
    # Views that the features were not made from: they have another mean, which is their origin.
    copytree(tmp_path / "room_0", tmp_path / "left_out" / "room_0")
    listing = tmp_path / "left_out" / "room_0" / "transforms.json"
    transforms = json.loads(listing.read_text())
    listing.write_text(json.dumps({**transforms, "frames": transforms["frames"][:1]}))
    ask_left_out = [ask[0], str(tmp_path / "left_out" / "room_0"), *ask[2:]]
    assert cli.main([*ask_left_out, f"features={folders}", f"out={tmp_path / 'one view'}", "quiet=true"]) == 0
    first = [line.split(",")[3] for line in pairs[1:] if line.split(",")[1] == transforms["frames"][0]["file_path"]]
    assert first
    assert results_of(tmp_path / "one view")["miou"] == pytest.approx(np.mean([float(iou) for iou in first]), abs=0.02)
    # The other protocols take them, too.
    named = ["evaluate", scene, "protocol=naming", f"features={folders}", f"out={tmp_path / 'named'}", "quiet=true"]
    assert cli.main(named) == 0
    assert results_of(tmp_path / "named")["accuracy"] > 0.99
    capsys.readouterr()
    assert cli.main([*ask, teacher, f"features={folders}", f"out={tmp_path / 'no'}"]) == 2
    assert "a folder has its own Gaussians and words" in capsys.readouterr().err
    write_room(made, tmp_path / "room_1")
    assert cli.main([*ask[:1], str(tmp_path / "room_1"), *ask[2:], f"features={folders / 'room_0'}", "out=x"]) == 2
    assert "holds those of scene room_0" in capsys.readouterr().err
