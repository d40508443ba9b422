"""Parts of `bench/gpu.py` with networks: encoder, memory, training, RADIO, ONNX; each yields rows of figures."""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from encoder import surface
from gpu_measure import Row, Setting, Skipped, compared, measured
from radios import small_radio
from splats import front_camera

from gsencoder.core.device import autocast_dtype
from gsencoder.memory.attention import MemoryAttention, random_projection
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder, encoder_inputs
from gsencoder.teachers.radio import RadioConfig, RadioTeacher
from gsencoder.types import FeatureSpace, MemoryBank, Views


def memory_attention(setting: Setting) -> Iterator[Row]:
    """Gaussian memory attention in float32 on the device, against float64 on the CPU, with its gradient."""
    rng = np.random.default_rng(0)
    count, channels = (50, 24) if setting.small else (5_000, 512)
    components = rng.normal(size=(count, channels)).astype(np.float32)
    bank = MemoryBank(
        components=components,
        sources=np.zeros((count, 3), np.int32),
        grid_from_image=np.tile(np.eye(2, 3), (count, 1, 1)),
        space=FeatureSpace(name="s", channels=channels),
        mean=np.zeros(channels, np.float32),
        threshold=0.9,
        coverage=1.0,
        cosine=1.0,
    )
    projection = random_projection(16, channels, torch.Generator().manual_seed(0))
    queries = torch.randn(200 if setting.small else 20_000, 16, generator=torch.Generator().manual_seed(1))
    made: list[tuple[torch.Tensor, torch.Tensor]] = []
    for device, dtype in ((setting.device, torch.float32), (torch.device("cpu"), torch.float64)):
        attention = MemoryAttention(bank, projection.clone(), mean=bank.mean, scoring="cosine", temperature=0.1)
        attention, ours = attention.to(device, dtype), queries.clone().to(device, dtype).requires_grad_()
        row: Row = {"what": f"forward and backward on {device.type} in {str(dtype).removeprefix('torch.')}"}
        # Libraries load, and kernels are chosen, at the first call.
        attention(ours).square().sum().backward()
        ours.grad = None
        with measured(setting, row):
            features = attention(ours)
            features.square().sum().backward()
        yield row
        assert ours.grad is not None
        made.append((features, ours.grad))
    yield compared("features", made[0][0], made[1][0], 1e-3)
    yield compared("gradient", made[0][1], made[1][1], 1e-2)


def encoder_parity(setting: Setting) -> Iterator[Row]:
    """The encoder in float32 and bfloat16 on the device against float32 on the CPU."""
    splat = surface(300 if setting.small else 30_000)
    network = GaussianEncoder(EncoderConfig(), 64).eval()
    attributes, opacities, cloud = encoder_inputs(splat, network.config, network.config.voxel)
    inputs = (attributes, opacities, network.join([cloud]))
    with torch.inference_mode():
        expected = network(*inputs)
        network.to(setting.device)
        for precision, most in (("float32", 1e-3), ("bfloat16", 1e-1)):
            dtype = autocast_dtype(precision, setting.device)  # type: ignore[arg-type]
            with torch.autocast(setting.device.type, dtype, enabled=dtype is not None):
                got = network(*(each.to(setting.device) for each in inputs))
            yield compared(precision, got, expected, most)


def encoder_cost(setting: Setting) -> Iterator[Row]:
    """Plan on the CPU, forward pass and training step by size, in float32 and bfloat16, the best of some rounds."""
    for size in (500,) if setting.small else (50_000, 100_000, 250_000):
        network = GaussianEncoder(EncoderConfig(), 64).to(setting.device)
        start = time.perf_counter()
        attributes, opacities, cloud = encoder_inputs(surface(size), network.config, network.config.voxel)
        plan = network.join([cloud])
        tokens = len(cloud.counts)
        yield {"what": "plan", "tokens": tokens, "precision": "", "seconds": time.perf_counter() - start}
        inputs = (attributes.to(setting.device), opacities.to(setting.device), plan.to(setting.device))
        optimizer = torch.optim.AdamW(network.parameters(), lr=1e-4)
        best: dict[tuple[str, str], Row] = {}
        for _ in range(2 if setting.small else 4):
            for precision in ("float32", "bfloat16") if setting.cuda else ("float32",):
                dtype = torch.bfloat16 if precision == "bfloat16" else None
                for what in ("forward", "step"):
                    row: Row = {"what": what, "tokens": tokens, "precision": precision}
                    network.train(what == "step")
                    with measured(setting, row), torch.autocast(setting.device.type, dtype, enabled=dtype is not None):
                        if what == "forward":
                            with torch.inference_mode():
                                network(*inputs)
                        else:
                            optimizer.zero_grad()
                            network(*inputs).square().mean().backward()
                            optimizer.step()
                    earlier = best.get((what, precision))
                    if earlier is None or row["seconds"] < earlier["seconds"]:
                        best[what, precision] = row
        yield from best.values()


def processes(setting: Setting) -> Iterator[Row]:
    """A training of a few steps by one process and by two, which share its batches: the losses are the same."""
    alone = setting.cuda and torch.cuda.device_count() < 2
    note = "NCCL" if setting.cuda and not alone else "gloo on the CPU"
    yield {"what": f"two processes with {note}" + (", since NCCL needs a GPU for each" if alone else "")}
    runs = ["cpu:1:float32", "cpu:2:float32"]
    if setting.cuda:
        runs += ["cuda:1:float32", "cuda:1:bfloat16"]
    if setting.cuda and not alone:
        runs += ["cuda:2:float32"]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-W", "ignore", str(Path(__file__).with_name("gpu_training.py")), folder, *runs]
        done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
        assert done.returncode == 0, done.stderr.strip()[-600:]
        losses = {run: torch.tensor(each) for run, each in json.loads(done.stdout.splitlines()[-1]).items()}
    for run in runs[1:]:
        device, count, precision = run.split(":")
        most = 5e-2 if precision == "bfloat16" else 1e-3
        yield compared(f"losses of {count} on {device} in {precision}", losses[run], losses[runs[0]], most)


def radio(setting: Setting) -> Iterator[Row]:
    """RADIO's map on the device (bfloat16 on a GPU that computes in it) against float32 on the CPU."""
    try:
        import transformers  # noqa: F401
    except ImportError as error:
        raise Skipped("package missing: transformers") from error
    picture = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    camera = front_camera(64, 48)
    views = Views(cameras=camera, names=("v",), images=[picture])
    with tempfile.TemporaryDirectory() as made:
        folder = setting.radio or small_radio(Path(made) / "radio")
        size = 64 if setting.radio is None else 768
        maps = []
        for device in (setting.device.type, "cpu"):
            teacher = RadioTeacher(RadioConfig(model=str(folder), size=size, device=device))  # type: ignore[arg-type]
            row: Row = {"what": f"map on {device}"}
            with measured(setting, row):
                maps.append(torch.from_numpy(teacher.feature_map(views, 0).features))
            yield row
    yield compared("map", maps[0], maps[1], 5e-2)


def onnx(setting: Setting) -> Iterator[Row]:
    """onnxruntime's CUDA provider against its CPU provider, on the shipped encoder."""
    try:
        import onnxruntime
    except ImportError as error:
        raise Skipped("package missing: onnxruntime") from error
    if not setting.cuda:
        raise Skipped("no CUDA device")
    if "CUDAExecutionProvider" not in onnxruntime.get_available_providers():
        raise Skipped("package missing: onnxruntime-gpu (this onnxruntime has no CUDAExecutionProvider)")
    from gsencoder.infer.load import load_encoder
    from gsencoder.infer.onnx.export import export_onnx, lower
    from gsencoder.infer.onnx.runtime import OnnxEncoder, feed_of

    encoder = load_encoder("house_cpu", "cpu")
    file = export_onnx(encoder, lower(encoder))  # type: ignore[arg-type]
    feed = feed_of(surface(20_000), None, 0.02)
    given = []
    for device in ("cuda", "cpu"):
        session = OnnxEncoder(file, device=device)._session  # type: ignore[arg-type]
        row: Row = {"what": f"20,000 tokens on {device}"}
        session.run(None, feed)
        with measured(setting, row):
            given.append(torch.from_numpy(session.run(None, feed)[0]))
        yield row
    yield compared("features", given[0], given[1], 1e-2)
