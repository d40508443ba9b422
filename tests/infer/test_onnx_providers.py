"""onnxruntime's providers, and torch's exporter where it is too old."""

import sys
from types import ModuleType
from typing import Any

import pytest
import torch

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.infer.onnx.runtime import CPU, CUDA, open_session
from gsencoder.infer.torch_network import TorchNetwork


class Onnxruntime(ModuleType):
    """An onnxruntime with a GPU provider, which loads or does not."""

    def __init__(self, loads: bool) -> None:
        super().__init__("onnxruntime")
        self.loads, self.given = loads, list[Any]()
        self.SessionOptions = type("SessionOptions", (), {})

    def get_available_providers(self) -> list[str]:
        return [CUDA, CPU]

    def preload_dlls(self) -> None:
        print("Failed to load libcudnn.so.9")

    def InferenceSession(self, model: bytes, options: Any, providers: list[Any]) -> Any:
        self.given = providers
        names = [each if isinstance(each, str) else each[0] for each in providers]
        used = names if self.loads else [CPU]
        return type("Session", (), {"get_providers": lambda _: used})()


def opened(monkeypatch: pytest.MonkeyPatch, device: Any, *, loads: bool) -> list[Any]:
    """The providers that a session was asked for."""
    runtime = Onnxruntime(loads)
    monkeypatch.setitem(sys.modules, "onnxruntime", runtime)
    open_session(b"", "the model", device)
    return runtime.given


def test_a_gpu_computes_in_float32_without_tensorfloat_and_the_loader_of_its_libraries_prints_nothing(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    assert opened(monkeypatch, "cuda", loads=True) == [(CUDA, {"use_tf32": "0"}), CPU]
    assert opened(monkeypatch, "cpu", loads=True) == [CPU]
    assert capfd.readouterr().out == ""


def test_a_gpu_whose_libraries_do_not_load_is_refused_by_name_and_warned_of_otherwise(monkeypatch):
    with pytest.raises(InputError, match="device=cuda: .* could not load CUDA or cuDNN"):
        opened(monkeypatch, "cuda", loads=False)
    with pytest.warns(SceneWarning, match="device=auto: .* computing on the CPU"):
        opened(monkeypatch, "auto", loads=False)


def test_an_exporter_that_is_too_old_is_named_and_a_fault_of_a_newer_one_is_not_hidden(monkeypatch):
    def fails(*_: Any, **__: Any) -> None:
        raise AssertionError("should have been constant, but got u2 - 1")

    network = TorchNetwork.load("rooms")
    monkeypatch.setattr(torch.export, "export", fails)
    with pytest.raises(AssertionError, match="should have been"):
        network.lower()
    monkeypatch.setattr(torch, "__version__", torch.torch_version.TorchVersion("2.11.0+cu130"))
    with pytest.raises(InputError, match=r"torch 2\.11\.0.*AssertionError.*torch 2\.13 or later"):
        network.lower()
