"""The parts of `bench/gpu.py`: each computes on a device, is held against the CPU, and gives rows of figures."""

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from encoder import surface
from fixed_teachers import EXACT, CodedTeacher, make_scene
from radios import small_radio
from splats import front_camera, random_gaussians

from gsencoder.core.runtime.device import autocast_dtype
from gsencoder.fusion.fuse import fuse
from gsencoder.fusion.teachers.radio import RadioConfig, RadioTeacher
from gsencoder.memory.attention import MemoryAttention, random_projection
from gsencoder.models.blocks import PatchAttention
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder, encoder_inputs
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.render.rasterize import RasterConfig, rasterize
from gsencoder.train.losses import LossConfig, contrast_loss, field_loss, render_loss
from gsencoder.types import FeatureSpace, MemoryBank, Views

Row = dict[str, Any]


class Skipped(Exception):
    """A part that cannot run here; the message says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """Where and how large.

    Attributes:
        device: of the run.
        small: sizes for a CPU in continuous integration.
        radio: folder of a RADIO release; None = a small one with random weights.
    """

    device: torch.device
    small: bool
    radio: Path | None = None

    @property
    def cuda(self) -> bool:
        return self.device.type == "cuda"


def relative_error(got: torch.Tensor, expected: torch.Tensor) -> float:
    """Largest difference, as a share of the largest expected magnitude."""
    expected = expected.detach().double().cpu()
    return float((got.detach().double().cpu() - expected).abs().max() / expected.abs().max().clamp(min=1e-30))


def held(name: str, got: torch.Tensor, expected: torch.Tensor, most: float) -> Row:
    """A row of a comparison, whose error may be `most`.

    Raises:
        AssertionError: it is larger, or not finite.
    """
    error = relative_error(got, expected)
    assert error <= most, f"{name}: error {error:.2e} is above {most:.0e}"
    return {"what": name, "error": error, "limit": most}


@contextmanager
def measured(setting: Setting, row: Row) -> Iterator[None]:
    """Adds seconds and, of a GPU, the peak of memory to a row."""
    if setting.cuda:
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
    start = time.perf_counter()
    yield
    if setting.cuda:
        torch.cuda.synchronize()
        row["peak_mib"] = torch.cuda.max_memory_allocated() / 2**20
    else:
        row["process_peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    row["seconds"] = time.perf_counter() - start


def blend_parity(setting: Setting) -> list[Row]:
    """B by torch on the device against numba: values, lift, gradients, bits of a second run; and a whole fusion."""
    count, size = (400, (61, 43)) if setting.small else (200_000, (640, 480))
    splat, camera = random_gaussians(count, log_scale=-2.5 if setting.small else -4.5), front_camera(*size, size[0])
    rows: list[Row] = []
    for rays, patch in ((1, None), (16, 8)):
        config = BlendConfig(rays_per_patch=rays, backend="torch")
        fast = blend(splat, camera, patch=patch, config=replace(config, backend="cpu"))
        row: Row = {"what": f"torch, {'pixels' if patch is None else 'patches'}"}
        blend(splat, camera, patch=patch, config=config, device=setting.device)
        with measured(setting, row):
            made = blend(splat, camera, patch=patch, config=config, device=setting.device)
        again = blend(splat, camera, patch=patch, config=config, device=setting.device)
        assert torch.equal(made.col, again.col), "a rerun differs"
        assert torch.equal(made.weight, again.weight), "a rerun differs"
        row["entries"] = len(made.col)
        rows += [row, *product_rows(made, fast, 1e-3)]
    scene = make_scene(150)
    codes = [np.random.default_rng(view).integers(-1, 7, (24, 32)).astype(np.int32) for view in range(5)]
    teacher = CodedTeacher(codes, np.random.default_rng(0).normal(size=(7, 6)).astype(np.float32))
    there = fuse(scene, teacher, replace(EXACT, blend=BlendConfig(backend="torch")), device=setting.device).features
    here = fuse(scene, teacher, EXACT, device="cpu").features
    seen = torch.from_numpy(here.weights > 1e-3)
    rows.append(held("fused weights", torch.from_numpy(there.weights), torch.from_numpy(here.weights), 1e-4))
    features = [torch.from_numpy(each.features)[seen] for each in (there, here)]
    return [*rows, held("fused features", features[0], features[1], 1e-3)]


def product_rows(made: Blend, expected: Blend, most: float) -> list[Row]:
    """Products of two blends of one view, and the gradients of them."""
    device, generator = made.weight.device, torch.Generator().manual_seed(0)
    values = torch.randn(expected.gaussians, 8, generator=generator)
    maps = torch.randn(expected.rows, 8, generator=generator)
    ours, theirs = (values.clone().to(to).requires_grad_() for to in (device, "cpu"))
    rendered = made.render(ours), expected.render(theirs)
    for each in rendered:
        (each * maps.to(each.device)).sum().backward()
    assert ours.grad is not None
    assert theirs.grad is not None
    return [
        held("render", rendered[0], rendered[1], most),
        held("lift", made.lift(maps.to(device)), expected.lift(maps), most),
        held("gradient of render", ours.grad, theirs.grad, most),
    ]


def sparse_products(setting: Setting) -> list[Row]:
    """The same matrix multiplied by numba and on the device: sums in another order."""
    made = blend(random_gaussians(400 if setting.small else 50_000), front_camera(160, 120, 130.0))
    moved = Blend(*(each for each in (made.crow, made.col, made.weight)), made.depths, made.lattice, made.config)
    moved = moved.to(setting.device)
    moved.config = replace(moved.config, backend="torch")
    rows = product_rows(moved, made, 1e-5)
    codes = torch.from_numpy(np.random.default_rng(0).integers(-1, 9, made.rows).astype(np.int32))
    sums = [torch.zeros(made.gaussians, 9, device=device) for device in (setting.device, "cpu")]
    moved.lift_codes_into(codes.to(setting.device), sums[0])
    made.lift_codes_into(codes, sums[1])
    return [*rows, held("lift of codes", sums[0], sums[1], 1e-5)]


def losses(setting: Setting) -> list[Row]:
    """Terms of the loss and their gradients in float32 on the device, against float64 on the CPU."""
    view, generator = blend(random_gaussians(300), front_camera(), patch=6), torch.Generator().manual_seed(0)
    predicted, target = (torch.randn(300, 8, generator=generator) for _ in range(2))
    codes, book = torch.randint(0, 5, (300,), generator=generator), torch.randn(5, 8, generator=generator)
    cells, config = torch.randn(view.rows, 8, generator=generator), LossConfig()
    terms: dict[str, Callable[[torch.Tensor, torch.device, torch.dtype], torch.Tensor]] = {
        "field": lambda x, d, t: field_loss(x, target.to(d, t), torch.ones(300, device=d, dtype=t), config),
        "contrast": lambda x, d, t: contrast_loss(
            x, codes.to(d), torch.ones(300, device=d, dtype=t), book.to(d, t), config
        ),
        "render": lambda x, d, t: render_loss(
            x, _typed(view, d, t), cells.to(d, t), torch.ones(view.rows, device=d, dtype=t), config
        ),
    }
    rows = []
    for name, term in terms.items():
        made = []
        for device, dtype in ((setting.device, torch.float32), (torch.device("cpu"), torch.float64)):
            x = predicted.clone().to(device, dtype).requires_grad_()
            value = term(x, device, dtype)
            value.backward()
            made.append((value, x.grad))
        rows.append(held(name, made[0][0], made[1][0], 1e-4))
        rows.append(held(f"gradient of {name}", made[0][1], made[1][1], 1e-3))  # type: ignore[arg-type]
    return rows


def _typed(view: Blend, device: torch.device, dtype: torch.dtype) -> Blend:
    made = Blend(view.crow, view.col, view.weight.to(dtype), view.depths.to(dtype), view.lattice, view.config)
    return made.to(device)


def memory_attention(setting: Setting) -> list[Row]:
    """Gaussian memory attention in float32 on the device, against float64 on the CPU, with its gradient."""
    rng = np.random.default_rng(0)
    count, channels = (50, 16) if setting.small else (5_000, 512)
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
    projection = random_projection(channels, 16, torch.Generator().manual_seed(0))
    queries = torch.randn(200 if setting.small else 20_000, 16, generator=torch.Generator().manual_seed(1))
    rows, made = [], []
    for device, dtype in ((setting.device, torch.float32), (torch.device("cpu"), torch.float64)):
        attention = MemoryAttention(bank, projection.clone(), mean=bank.mean, scoring="cosine", temperature=0.1)
        attention, asked = attention.to(device, dtype), queries.clone().to(device, dtype).requires_grad_()
        given = attention(asked)
        given.square().sum().backward()
        made.append((given, asked.grad))
    rows.append(held("features", made[0][0], made[1][0], 1e-3))
    rows.append(held("gradient", made[0][1], made[1][1], 1e-2))  # type: ignore[arg-type]
    return rows


def gsplat_parity(setting: Setting) -> list[Row]:
    """gsplat's rasterizer against numba's, values and gradients; 200 steps of Adam on the colors of a small scene."""
    if not setting.cuda:
        raise Skipped("no CUDA device")
    try:
        import gsplat  # type: ignore[import-not-found] # noqa: F401
    except ImportError as error:
        raise Skipped("package missing: gsplat (pip install 'gsencoder[gpu]')") from error
    splat, camera = random_gaussians(3000, log_scale=-3.0), front_camera(160, 120, 130.0)
    names = ("means", "quats", "scales", "opacities")
    made = []
    for device in (setting.device, torch.device("cpu")):
        inputs = [torch.from_numpy(getattr(splat, name)).to(device).requires_grad_() for name in names]
        inputs.append(torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)).to(device).requires_grad_())
        view = [torch.from_numpy(each[0]).to(device) for each in (camera.cam_from_world, camera.Ks)]
        raster = rasterize(*inputs, *view, 160, 120, config=RasterConfig())  # type: ignore[arg-type]
        (raster.rgb.square().sum() + raster.alpha.sum()).backward()
        made.append((raster, inputs, view))
    rows = [
        held(name, getattr(made[0][0], name), getattr(made[1][0], name), 1e-2) for name in ("rgb", "alpha", "depth")
    ]
    for name, one, other in zip((*names, "colors"), made[0][1], made[1][1], strict=True):
        rows.append(held(f"gradient of {name}", one.grad, other.grad, 5e-2))
    raster, inputs, view = made[0]
    goal, still = raster.rgb.detach(), [each.detach() for each in inputs[:4]]
    colors = torch.full_like(inputs[4], 0.5).requires_grad_()
    adam, row = torch.optim.Adam([colors], lr=0.02), {"what": "200 steps"}
    errors = []
    with measured(setting, row):
        for _ in range(200):
            adam.zero_grad()
            error = (rasterize(*still, colors, *view, 160, 120, config=RasterConfig()).rgb - goal).square().mean()
            error.backward()
            adam.step()
            errors.append(float(error.detach()))
    assert errors[-1] < errors[0] / 20, f"the error fell from {errors[0]:.2e} to {errors[-1]:.2e} alone"
    return [*rows, row | {"first": errors[0], "last": errors[-1]}]


def encoder_parity(setting: Setting) -> list[Row]:
    """The encoder in float32 and bfloat16 on the device, with masks as an argument and folded, against the CPU's."""
    splat = surface(300 if setting.small else 30_000)
    network = GaussianEncoder(EncoderConfig(), 64).eval()
    expected = _forward(network, splat, Setting(device=torch.device("cpu"), small=True), None, None)
    rows = []
    for precision, most in (("float32", 1e-3), ("bfloat16", 1e-1)):
        for folds in (False, True):
            dtype = autocast_dtype(precision, setting.device)  # type: ignore[arg-type]
            got = _forward(network, splat, setting, dtype, folds)
            rows.append(held(f"{precision}, {'folded mask' if folds else 'mask'}", got, expected, most))
    return rows


def _forward(
    network: GaussianEncoder, splat: Any, setting: Setting, dtype: torch.dtype | None, folds: bool | None
) -> torch.Tensor:
    network.to(setting.device)
    _set_form(network, folds)
    attributes, opacities, cloud = encoder_inputs(splat, network.config, network.config.voxel)
    plan = network.join([cloud]).to(setting.device)
    with torch.inference_mode(), torch.autocast(setting.device.type, dtype, enabled=dtype is not None):
        out: torch.Tensor = network(attributes.to(setting.device), opacities.to(setting.device), plan)
    return out.cpu()


def _set_form(network: GaussianEncoder, folds: bool | None) -> None:
    for module in network.modules():
        if isinstance(module, PatchAttention):
            module.folds_mask = folds


def encoder_cost(setting: Setting) -> list[Row]:
    """Forward pass and training step by size, in turn with masks as an argument and folded."""
    rows: list[Row] = []
    dtype = torch.bfloat16 if setting.cuda else None
    for size in (500,) if setting.small else (50_000, 100_000, 250_000):
        network = GaussianEncoder(EncoderConfig(), 64).to(setting.device)
        attributes, opacities, cloud = encoder_inputs(surface(size), network.config, network.config.voxel)
        inputs = (attributes.to(setting.device), opacities.to(setting.device), network.join([cloud]).to(setting.device))
        optimizer = torch.optim.AdamW(network.parameters(), lr=1e-4)
        forms: dict[tuple[str, bool], Row] = {}
        for _ in range(2 if setting.small else 4):
            for folds in (False, True):
                _set_form(network, folds)
                for what in ("forward", "step"):
                    row: Row = {"what": what, "tokens": len(cloud.counts), "mask": "folded" if folds else "argument"}
                    network.train(what == "step")
                    with measured(setting, row), torch.autocast(setting.device.type, dtype, enabled=dtype is not None):
                        if what == "forward":
                            with torch.inference_mode():
                                network(*inputs)
                        else:
                            optimizer.zero_grad()
                            network(*inputs).square().mean().backward()
                            optimizer.step()
                    best = forms.get((what, folds))
                    forms[what, folds] = row if best is None or row["seconds"] < best["seconds"] else best
        rows += forms.values()
    return rows


def processes(setting: Setting) -> list[Row]:
    """A training of a few steps by one process and by two, which share its batches: the losses are the same."""
    if setting.cuda and torch.cuda.device_count() < 2:
        device, note = "cpu", "two processes with gloo on the CPU, since NCCL needs a GPU for each and there is one"
    else:
        device, note = setting.device.type, "NCCL" if setting.cuda else "gloo"
    rows: list[Row] = [{"what": "processes", "with": note}]
    with tempfile.TemporaryDirectory() as folder:
        runs = [("cpu", 1), ("cpu", 2)] if device == "cpu" else [("cuda", 1), ("cuda", 2)]
        if setting.cuda and device == "cpu":
            runs.append(("cuda", 1))
        command = [sys.executable, "-W", "ignore", str(Path(__file__).with_name("gpu_training.py")), folder]
        command += [f"{name}:{count}" for name, count in runs]
        done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
        assert done.returncode == 0, done.stderr.strip()[-600:]
        made = json.loads(done.stdout.splitlines()[-1])
    expected = torch.tensor(made[f"{runs[0][0]}:1"])
    for name, count in runs[1:]:
        rows.append(held(f"losses of {count} on {name}", torch.tensor(made[f"{name}:{count}"]), expected, 1e-2))
    return rows


def radio(setting: Setting) -> list[Row]:
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
        return [row, held("map", maps[0], maps[1], 5e-2)]


def onnx(setting: Setting) -> list[Row]:
    """onnxruntime's CUDA provider against its CPU provider, on the shipped encoder."""
    try:
        import onnxruntime
    except ImportError as error:
        raise Skipped("package missing: onnxruntime") from error
    if not setting.cuda:
        raise Skipped("no CUDA device")
    if "CUDAExecutionProvider" not in onnxruntime.get_available_providers():
        raise Skipped("package missing: onnxruntime-gpu (this onnxruntime has no CUDAExecutionProvider)")
    from gsencoder.infer.load_encoder import load_encoder
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
    return [row, held("features", given[0], given[1], 1e-2)]
