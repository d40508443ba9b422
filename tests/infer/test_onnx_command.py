"""What `export` says and refuses, and its file in an interpreter that has no torch."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from torch import nn

from gsencoder.app import main as cli
from gsencoder.data.splats.files import save_splat
from gsencoder.fusion.measured_heads import HeadSet, MeasuredHead, save_heads
from gsencoder.infer.encode import TOLERANCE, Encoder
from gsencoder.infer.onnx.export import random_cloud
from gsencoder.infer.torch_network import TorchNetwork
from gsencoder.teachers.base import Head

pytestmark = pytest.mark.slow


def test_the_command_tells_what_it_compared(exported: Path) -> None:
    results = json.loads((exported / "encoder.onnx.summary.json").read_text())["results"]
    assert results["onnx"] == str(exported / "encoder.onnx")
    assert set(results["parity"]) == {"1 random Gaussians", "50 random Gaussians"}
    assert 0 <= max(results["parity"].values()) < TOLERANCE
    assert (results["rank"], results["channels"], results["words"]) == (4, 6, 3)
    assert results["bytes"] == (exported / "encoder.onnx").stat().st_size


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["out=encoder.safetensors"], "expected a file that ends in .onnx"),
        (["out=encoder.onnx", "sizes=[0]"], "sizes: expected 1 to 10,000,000, got [0]"),
        (["out=encoder.onnx", "weights=nothing"], "weights: no file at nothing"),
        (["out=taken.onnx"], "taken.onnx: exists; give another out= or overwrite=true"),
        (["out=encoder.onnx", "none.ply"], "none.ply"),
        ([], "out= is missing"),
    ],
)
def test_the_command_refuses_before_it_begins(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken.onnx").touch()
    assert cli.main(["export", *words]) == 2
    assert message in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["taken.onnx"]


def test_without_the_packages_of_an_export_it_says_what_to_install_and_still_has_help(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnx", None)
    monkeypatch.delitem(sys.modules, "gsencoder.infer.onnx.export", raising=False)
    assert cli.main(["export", "--help"]) == 0
    capsys.readouterr()
    assert cli.main(["export", f"out={tmp_path / 'encoder.onnx'}"]) == 2
    assert capsys.readouterr().err == "error: export needs the package onnx: pip install 'gsencoder[export]'\n"
    assert not list(tmp_path.iterdir())


def test_words_are_found_in_an_interpreter_that_has_no_torch_and_by_the_example(exported: Path, tmp_path: Path) -> None:
    cloud = random_cloud(2000, 0.05)
    # Half of the sheet is white and the other black, so that even an untrained encoder tells them apart.
    left = cloud.means[:, :1] < 0
    save_splat(tmp_path / "room.ply", replace(cloud, sh=np.where(left, 1.5, -1.5).repeat(3, 1)[:, None].astype("f4")))
    example = Path(__file__).parents[2] / "examples" / "05_onnx_without_torch.py"
    assert len(example.read_text().splitlines()) <= 30
    code = (
        "import sys\n"
        "class NoTorch:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.partition('.')[0] == 'torch':\n"
        "            raise ModuleNotFoundError('no torch here', name=name)\n"
        "sys.meta_path.insert(0, NoTorch())\n"
        "from gsencoder.app.main import main\n"
        f"splat, weights, out = {str(tmp_path / 'room.ply')!r}, {str(exported / 'encoder.onnx')!r}, {str(tmp_path)!r}\n"
        "assert main(['encode', splat, f'weights={weights}', f'out={out}/features']) == 0\n"
        "from gsencoder import load_splat, localize\n"
        "from gsencoder.fusion.folder import load_features\n"
        "from gsencoder.infer.encode import Encoder\n"
        "scene = load_features(__import__('pathlib').Path(out) / 'features')\n"
        "assert len(localize(scene, ['mugs'], Encoder.load(weights).words).boxes) > 0\n"
        "import runpy\n"
        "for word in ('mug', 'unicorn'):\n"
        "    sys.argv = ['example', weights, splat, word]\n"
        f"    runpy.run_path({str(example)!r}, run_name='__main__')\n"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert done.returncode == 1, done.stderr
    assert "\nmug at [" in done.stdout
    assert done.stderr.splitlines()[-1].startswith("error: not among the 3 words of words-6: 'unicorn'")


def test_an_exported_encoder_carries_its_heads(weights, lowered, tmp_path, monkeypatch):
    monkeypatch.setattr(TorchNetwork, "lower", lambda _: lowered)
    shutil.copytree(weights, tmp_path / "encoder")
    head = Head(name="siglip.summary", body=nn.Sequential(nn.Linear(6, 4)))
    heads = HeadSet(
        space=Encoder.load(str(weights)).spaces["labels"],
        heads=(MeasuredHead(head=head, mean=np.zeros(4, np.float32), scale=1.0, cells=1, cosine=1.0, worst=1.0),),
    )
    beside = tmp_path / "encoder" / "heads.safetensors"
    save_heads(beside, heads)
    graph = tmp_path / "e.onnx"
    assert cli.main(["export", f"weights={beside.parent}", "sizes=[1]", f"out={graph}", "quiet=true"]) == 0
    assert (tmp_path / "e.onnx.heads.safetensors").read_bytes() == beside.read_bytes()
    save_splat(tmp_path / "room.ply", random_cloud(50, 0.05))
    out = tmp_path / "features"
    assert cli.main(["encode", str(tmp_path / "room.ply"), f"weights={graph}", f"out={out}", "quiet=true"]) == 0
    assert (out / "heads.safetensors").read_bytes() == beside.read_bytes()
