"""`evaluate` and `score` with ScanNet++'s lists of classes, on a room in its files."""

from pathlib import Path

import numpy as np
import pytest
from command_runs import results_of
from labeled_scans import ROOM_NAMES, write_scannetpp_scan

from gsencoder.app import main as cli
from gsencoder.data.synthetic import make_room
from gsencoder.text.table import make_text_table, save_text_table

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan, its words, and lists: the first class, with the id 0, is a thing that the room has."""
    folder = tmp_path_factory.mktemp("scannetpp")
    made = make_room(0, objects=4, views=4, width=64, height=48)
    write_scannetpp_scan(made, folder / "scans" / "room")
    names = list(dict.fromkeys(each.name for each in made.objects if each.name))
    words = [*names, *ROOM_NAMES.values()]
    save_text_table(folder / "words.safetensors", make_text_table(words, np.eye(len(words), dtype=np.float32), "w"))
    (folder / "top100.txt").write_text("".join(f"{name}\n" for name in names))
    (folder / "top100_instance.txt").write_text("".join(f"{name}\n" for name in names[1:]))
    rows = ["class,count,instance_map_to,semantic_map_to", *(f"{name},1,," for name in names), "floor,1,None,None"]
    (folder / "map_benchmark.csv").write_text("\n".join(rows) + "\n")
    return folder


@pytest.mark.parametrize("protocol", ["semantics", "instances"])
def test_scans_and_the_files_that_evaluate_writes_have_one_truth(protocol, home, tmp_path, monkeypatch):
    monkeypatch.setattr("gsencoder.evaluate.benchmarks.instances.MIN_REGION", 20)
    lists = [f"classes={home / 'top100.txt'}", f"label_map={home / 'map_benchmark.csv'}"]
    words = f"teacher.words={home / 'words.safetensors'}"
    seeds = ["seeds.source=mesh", f"seeds.mesh={home / 'scans' / 'room' / 'scans' / 'mesh_aligned_0.05.ply'}"]
    command = ["evaluate", str(home / "scans" / "room"), f"protocol={protocol}", words, *lists, *seeds]
    assert cli.main([*command, f"out={tmp_path / 'a'}", "quiet=true"]) == 0
    first = results_of(tmp_path / "a")
    del first["gaussians"]
    predictions = f"predictions={tmp_path / 'a' / 'predictions'}"
    for name, more in (
        ("files", [f"truth={tmp_path / 'a' / 'truth'}", lists[0]]),
        ("scans", [f"truth={home / 'scans'}", *lists]),
    ):
        out = f"out={tmp_path / name}"
        assert cli.main(["score", protocol, predictions, *more, out, "quiet=true"]) == 0
        assert results_of(tmp_path / name) == first
    if protocol == "semantics":
        assert first["miou"] > 0.5
        labels = {int(line) for line in (tmp_path / "a" / "truth" / "room.txt").read_text().split()}
        assert {-100, 0} <= labels
