"""What figures were measured on: machine, threads, versions, commit and date."""

import os
import platform
import re
import subprocess
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("torch", "numpy", "numba", "scipy", "scikit-learn", "onnxruntime", "open3d", "pycolmap", "transformers")
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def machine_of_now(checkout: Path) -> dict[str, str]:
    """Facts by name, each on one line."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    threads = [f"{name}={os.environ[name]}" for name in THREADS if name in os.environ]
    return {
        "date": time.strftime("%Y-%m-%d"),
        "commit": commit_of(checkout),
        "processor": f"{_line('/proc/cpuinfo', 'model name') or platform.processor()}, {cores} cores",
        "memory": f"{int((_line('/proc/meminfo', 'MemTotal') or '0').split()[0]) / 2**20:.0f} GiB",
        "system": f"{platform.system()} {platform.machine()}",
        "threads": ", ".join(threads) or "as the libraries choose",
        "priority": f"nice {os.nice(0)}",
        "python": platform.python_version(),
        **{name: version_of(name) for name in PACKAGES},
    }


def commit_of(checkout: Path) -> str:
    """The commit of a checkout, and whether tracked files differ from it."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(checkout), *words]
        try:
            return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
        except (OSError, subprocess.CalledProcessError):
            return ""

    commit = git("rev-parse", "--short=12", "HEAD")
    changed = git("status", "--porcelain", "--untracked-files=no")
    return f"{commit or 'unknown'}{' with changes' if changed else ''}"


def version_of(name: str) -> str:
    """The version of an installed package."""
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _line(file: str, key: str) -> str:
    """The value of a line `key : value`; empty where there is none."""
    try:
        found = re.search(rf"^{key}\s*:\s*(.*)$", Path(file).read_text(), re.MULTILINE)
    except OSError:
        return ""
    return found[1].strip() if found else ""
