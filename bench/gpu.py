"""What a GPU gives compared with the CPU, in one command: parity of every path on CUDA, and what it costs.

    python bench/gpu.py [--out gpu.md] [--small] [--device auto|cpu|cuda] [--radio FOLDER] [--parts blend,onnx]

Parts run one after the other; one that fails is reported with its error, and the others go on. The report is Markdown
for docs/results/gpu.md, with a JSON file next to it. The exit code is 1 if a part failed. `--small` takes sizes for a
CPU.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

BENCH = Path(__file__).resolve().parent
sys.path[:0] = [str(BENCH), str(BENCH.parent / "tests")]

import numpy as np  # noqa: E402
import torch  # noqa: E402
from encoder import surface  # noqa: E402
from fixed_teachers import EXACT, CodedTeacher, make_scene  # noqa: E402
from machine import machine_of_now, version_of  # noqa: E402
from radios import small_radio  # noqa: E402
from splats import front_camera, random_gaussians  # noqa: E402

from gsencoder.core.device import autocast_dtype, choose_device, to_device  # noqa: E402
from gsencoder.fusion.fuse import fuse  # noqa: E402
from gsencoder.memory.attention import MemoryAttention, random_projection  # noqa: E402
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder, encoder_inputs  # noqa: E402
from gsencoder.render import Blend, BlendConfig, blend  # noqa: E402
from gsencoder.render.rasterize import RasterConfig, rasterize  # noqa: E402
from gsencoder.teachers.radio import RadioConfig, RadioTeacher  # noqa: E402
from gsencoder.train.losses import LossConfig, contrast_loss, field_loss, render_loss  # noqa: E402
from gsencoder.types import FeatureSpace, MemoryBank, Views  # noqa: E402

Row = dict[str, Any]


class Skipped(Exception):
    """A part that cannot run here; the message says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """Where and how large; without a folder of a RADIO release, `radio` is a small one with random weights."""

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


def mean_error(got: torch.Tensor, expected: torch.Tensor) -> float:
    """Mean difference, as a share of the mean expected magnitude."""
    expected = expected.detach().double().cpu()
    return float((got.detach().double().cpu() - expected).abs().mean() / expected.abs().mean().clamp(min=1e-30))


def compared(name: str, got: torch.Tensor, expected: torch.Tensor, most: float, most_mean: float | None = None) -> Row:
    """A row of a comparison, whose largest error may be `most`, and whose mean error `most_mean` if one is given."""
    row: Row = {"what": name, "error": relative_error(got, expected), "limit": most}
    if most_mean is not None:
        row |= {"mean error": mean_error(got, expected), "limit of the mean": most_mean}
    return row


def broken_limits(rows: list[Row]) -> list[str]:
    """The comparisons whose error is above its limit, or not a number."""
    pairs = (("error", "limit"), ("mean error", "limit of the mean"))
    return [
        f"{row['what']}: {error} {row[error]:.2e} is above {row[limit]:.0e}"
        for row in rows
        for error, limit in pairs
        if error in row and not row[error] <= row[limit]
    ]


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


def blend_parity(setting: Setting) -> Iterator[Row]:
    """B by torch on the device against numba: values, lift, gradients, bits of a second run; and a whole fusion.

    Two orders of summation put an alpha near 1/255, or the transmittance at which a ray ends, on either side of its
    threshold, which moves a ray by 1/255 of a value at most: hence a limit for the largest and one for the mean error.
    """
    count, size = (400, (61, 43)) if setting.small else (200_000, (640, 480))
    splat, camera = random_gaussians(count, log_scale=-2.5 if setting.small else -4.5), front_camera(*size, size[0])
    for rays, patch in ((1, None), (16, 8)):
        config = BlendConfig(rays_per_patch=rays, backend="torch")
        what = f"torch, {'pixels' if patch is None else 'patches'}"
        fast = blend(splat, camera, patch=patch, config=replace(config, backend="cpu"))
        row: Row = {"what": what}
        blend(splat, camera, patch=patch, config=config, device=setting.device)
        with measured(setting, row):
            made = blend(splat, camera, patch=patch, config=config, device=setting.device)
        again = blend(splat, camera, patch=patch, config=config, device=setting.device)
        for name in ("crow", "col", "weight"):
            assert torch.equal(getattr(made, name), getattr(again, name)), f"a second run gives another {name}"
        yield row | {"entries": len(made.col), "entries of numba": len(fast.col)}
        yield from product_rows(made, fast, 5e-3, 1e-4)
    scene = make_scene(150)
    codes = [np.random.default_rng(view).integers(-1, 7, (24, 32)).astype(np.int32) for view in range(5)]
    teacher = CodedTeacher(codes, np.random.default_rng(0).normal(size=(7, 6)).astype(np.float32))
    there = fuse(scene, teacher, replace(EXACT, blend=BlendConfig(backend="torch")), device=setting.device).features
    here = fuse(scene, teacher, EXACT, device="cpu").features
    seen = torch.from_numpy(here.weights > 1e-3)
    yield compared("fused weights", torch.from_numpy(there.weights), torch.from_numpy(here.weights), 1e-4)
    features = [torch.from_numpy(each.features)[seen] for each in (there, here)]
    yield compared("fused features", features[0], features[1], 1e-3)


def product_rows(made: Blend, expected: Blend, most: float, most_mean: float) -> Iterator[Row]:
    """Products of two blends of one view, and the gradients of them."""
    device, generator = made.weight.device, torch.Generator().manual_seed(0)
    values = torch.randn(expected.gaussians, 8, generator=generator)
    maps = torch.randn(expected.rows, 8, generator=generator)
    ours, theirs = (values.clone().to(to).requires_grad_() for to in (device, "cpu"))
    rendered = made.render(ours), expected.render(theirs)
    for each in rendered:
        (each * maps.to(each.device)).sum().backward()
    yield compared("render", rendered[0], rendered[1], most, most_mean)
    yield compared("lift", made.lift(maps.to(device)), expected.lift(maps), most, most_mean)
    yield compared("gradient of render", ours.grad, theirs.grad, most, most_mean)


def sparse_products(setting: Setting) -> Iterator[Row]:
    """The same matrix multiplied by numba and on the device: sums in another order."""
    made = blend(random_gaussians(400 if setting.small else 50_000), front_camera(160, 120, 130.0))
    moved = Blend(made.crow, made.col, made.weight, made.depths, made.lattice, made.config)
    moved = moved.to(setting.device)
    moved.config = replace(moved.config, backend="torch")
    yield from product_rows(moved, made, 1e-5, 1e-5)
    codes = torch.from_numpy(np.random.default_rng(0).integers(-1, 9, made.rows).astype(np.int32))
    sums = [torch.zeros(made.gaussians, 9, device=device) for device in (setting.device, "cpu")]
    moved.lift_codes_into(codes.to(setting.device), sums[0])
    made.lift_codes_into(codes, sums[1])
    yield compared("lift of codes", sums[0], sums[1], 1e-5)


def losses(setting: Setting) -> Iterator[Row]:
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
    for name, term in terms.items():
        made = []
        for device, dtype in ((setting.device, torch.float32), (torch.device("cpu"), torch.float64)):
            x = predicted.clone().to(device, dtype).requires_grad_()
            value = term(x, device, dtype)
            value.backward()
            made.append((value, x.grad))
        yield compared(name, made[0][0], made[1][0], 1e-4)
        yield compared(f"gradient of {name}", made[0][1], made[1][1], 1e-3)  # type: ignore[arg-type]


def _typed(view: Blend, device: torch.device, dtype: torch.dtype) -> Blend:
    made = Blend(view.crow, view.col, view.weight.to(dtype), view.depths.to(dtype), view.lattice, view.config)
    return made.to(device)


def gsplat_parity(setting: Setting) -> Iterator[Row]:
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
    for name in ("rgb", "alpha", "depth"):
        yield compared(name, getattr(made[0][0], name), getattr(made[1][0], name), 1e-2)
    for name, one, other in zip((*names, "colors"), made[0][1], made[1][1], strict=True):
        yield compared(f"gradient of {name}", one.grad, other.grad, 5e-2)
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
    yield row | {"first": errors[0], "last": errors[-1]}


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
                got = network(*to_device(inputs, setting.device))
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
        inputs = (attributes.to(setting.device), opacities.to(setting.device), to_device(plan, setting.device))
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
    from gsencoder.infer.onnx.export import export_onnx
    from gsencoder.infer.onnx.runtime import OnnxNetwork, feed_of
    from gsencoder.infer.torch_network import TorchNetwork

    network = TorchNetwork.load("house")
    file = export_onnx(network.header, network.lower())
    feed = feed_of(surface(20_000), None, 0.02)
    given = []
    for device in ("cuda", "cpu"):
        session = OnnxNetwork(file, device=device).session  # type: ignore[arg-type]
        row: Row = {"what": f"20,000 tokens on {device}"}
        session.run(None, feed)
        with measured(setting, row):
            given.append(torch.from_numpy(session.run(None, feed)[0]))
        yield row
    yield compared("features", given[0], given[1], 1e-2)


Part = Callable[[Setting], Iterator[Row]]
GPU_PACKAGES = ("triton", "gsplat", "onnxruntime-gpu")


def environment(setting: Setting) -> Iterator[Row]:
    """Machine, card, driver and versions."""
    for name, value in machine_of_now(BENCH.parent).items():
        yield {"what": name, "value": value}
    if setting.cuda:
        properties = torch.cuda.get_device_properties(setting.device)
        card = f"{properties.name}, {properties.total_memory / 2**30:.0f} GiB, compute capability {properties.major}."
        yield {"what": "card", "value": card + str(properties.minor)}
        yield {"what": "CUDA of torch", "value": str(torch.version.cuda)}
        query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
        done = subprocess.run(query, capture_output=True, text=True, check=False, timeout=30)
        yield {"what": "driver", "value": done.stdout.strip() or done.stderr.strip()}
    for name in GPU_PACKAGES:
        yield {"what": name, "value": version_of(name)}


PARTS: dict[str, Part] = {
    "environment": environment,
    "blend": blend_parity,
    "products": sparse_products,
    "losses": losses,
    "memory": memory_attention,
    "gsplat": gsplat_parity,
    "encoder": encoder_parity,
    "encoder_cost": encoder_cost,
    "processes": processes,
    "radio": radio,
    "onnx": onnx,
}


def run_parts(setting: Setting, parts: Mapping[str, Part]) -> list[dict[str, Any]]:
    """Runs the parts. One fails if it raises, or if an error is above its limit; its rows up to there stay."""
    results = []
    for name, part in parts.items():
        start, rows = time.perf_counter(), []
        try:
            for row in part(setting):
                rows.append(row)
            broken = broken_limits(rows)
            state = f"failed: {'; '.join(broken)}" if broken else "ok"
        except Skipped as reason:
            state = f"skipped: {reason}"
        except Exception as error:
            # Everything is caught: a failure must not cost the rest of the minutes on a borrowed card.
            where = traceback.extract_tb(error.__traceback__)[-1]
            lines = str(error).strip().splitlines() or [""]
            state = f"failed: {type(error).__name__}: {lines[0][:300]} ({Path(where.filename).name}:{where.lineno})"
        seconds = time.perf_counter() - start
        what = (part.__doc__ or "").strip().splitlines()
        results.append(
            {"part": name, "what": what[0] if what else "", "state": state, "seconds": seconds, "rows": rows}
        )
        print(f"{name}: {state}, {seconds:.1f} s", flush=True)
    return results


def markdown(setting: Setting, results: list[dict[str, Any]]) -> str:
    """The report."""
    lines = [f"## GPU run on {setting.device.type}", ""]
    lines += [f"`python bench/gpu.py{' --small' if setting.small else ''}`, {time.strftime('%Y-%m-%d')}.", ""]
    lines += ["| part | result | seconds |", "|---|---|---|"]
    lines += [f"| {each['part']} | {_cell(each['state'])} | {each['seconds']:.1f} |" for each in results]
    for each in results:
        lines += ["", f"**{each['part']}.** {each['what']}"]
        if not each["rows"]:
            continue
        columns = list(dict.fromkeys(name for row in each["rows"] for name in row))
        lines += ["", f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
        lines += [f"| {' | '.join(_cell(row.get(name, '')) for name in columns)} |" for row in each["rows"]]
    return "\n".join(lines) + "\n"


def _cell(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value).replace("|", "\\|").replace("\n", " ")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("gpu.md"))
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--device", default="auto", choices=["auto", "cpu", "cuda"])
    parser.add_argument("--radio", type=Path, help="folder of a RADIO release")
    parser.add_argument("--parts", default=",".join(PARTS), help=f"of {', '.join(PARTS)}")
    chosen = parser.parse_args()
    names = chosen.parts.split(",")
    if unknown := [name for name in names if name not in PARTS]:
        parser.error(f"--parts: expected some of {', '.join(PARTS)}, got {', '.join(unknown)}")
    setting = Setting(device=choose_device(chosen.device), small=chosen.small, radio=chosen.radio)
    results = run_parts(setting, {name: PARTS[name] for name in names})
    chosen.out.parent.mkdir(parents=True, exist_ok=True)
    chosen.out.write_text(markdown(setting, results), encoding="utf-8")
    chosen.out.with_suffix(".json").write_text(json.dumps(results, indent=1), encoding="utf-8")
    print(f"{chosen.out}, {chosen.out.with_suffix('.json')}")
    return int(any(each["state"].startswith("failed") for each in results))


if __name__ == "__main__":
    sys.exit(main())
