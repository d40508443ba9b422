"""What a GPU gives beside the CPU, in one command: parity of every path on CUDA, and what it costs.

    python bench/gpu.py [--out gpu.md] [--small] [--device auto|cpu|cuda] [--radio FOLDER] [--parts blend,onnx]

Parts run one after the other; one that fails is reported with its error, and the others go on. The report is Markdown
for docs/measurements.md, with a JSON file beside it. The exit code is 1 if a part failed. `--small` takes sizes for a
CPU.
"""

import argparse
import json
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

BENCH = Path(__file__).resolve().parent
sys.path[:0] = [str(BENCH), str(BENCH.parent / "tests")]

import gpu_networks  # noqa: E402
import gpu_render  # noqa: E402
import torch  # noqa: E402
from gpu_measure import Row, Setting, Skipped, broken_limits  # noqa: E402
from machine import machine_of_now, version_of  # noqa: E402

from gsencoder.core.device import choose_device  # noqa: E402

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
    "blend": gpu_render.blend_parity,
    "products": gpu_render.sparse_products,
    "losses": gpu_render.losses,
    "memory": gpu_networks.memory_attention,
    "gsplat": gpu_render.gsplat_parity,
    "encoder": gpu_networks.encoder_parity,
    "encoder_cost": gpu_networks.encoder_cost,
    "processes": gpu_networks.processes,
    "radio": gpu_networks.radio,
    "onnx": gpu_networks.onnx,
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
