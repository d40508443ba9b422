"""`gsencoder repair PATH out=FILE`: repairs defects of a splat file, or wrong poses and depth of a scene, and reports
the changes."""

import secrets
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from gsencoder.app.options import CommonConfig
from gsencoder.app.run import Run
from gsencoder.core.errors import InputError
from gsencoder.core.files import write_json
from gsencoder.core.settings import option
from gsencoder.data.scenes import SceneConfig, has_views, load_scene, read_posed
from gsencoder.data.splats.files import (
    READABLE,
    WRITABLE,
    RawSplat,
    check_splat_name,
    gaussians_from_raw,
    read_raw,
    save_splat,
)
from gsencoder.data.splats.repair import repair_splat
from gsencoder.types import Scene

Fix = Literal["activated", "nonfinite", "quats", "scales", "opacities", "huge", "duplicates", "floaters", "all"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RepairConfig(CommonConfig):
    """Settings of `repair`."""

    paths: tuple[str, ...] = option(
        (),
        f"a scene with posed views, or one splat: {READABLE}",
        metavar="PATH",
        required=True,
        one="splat file or scene",
    )
    out: Path | None = option(
        None,
        f"the file to write: of a scene .json (nerfstudio), of a splat {WRITABLE}; FILE.summary.json next to it holds "
        "the changes",
        metavar="FILE",
        required=True,
    )
    fix: tuple[Fix, ...] = option(
        ("nonfinite", "quats", "scales", "opacities"),
        "defects of a splat to repair: the four that prevent loading, activated (scales or opacities that "
        "are no logarithms or logits), huge, duplicates, floaters, or all",
    )
    views: int = option(
        0, "largest number of a scene's views to hold against each other; 0 = 32 with depth, else 24", ge=0
    )
    data: SceneConfig = field(default_factory=SceneConfig)

    def __post_init__(self) -> None:
        CommonConfig.__post_init__(self)
        if self.views == 1:
            raise InputError("views: expected 0 or at least 2, got 1")
        if not self.fix:
            raise InputError("fix: expected the name of a defect, got none (gsencoder inspect lists them)")


def run(config: RepairConfig, run: Run) -> None:
    """Reads, repairs and writes a splat or the poses of a scene, and prints each change."""
    assert config.out is not None
    path = Path(config.paths[0])
    is_scene = path.exists() and has_views(path)
    if is_scene and config.out.suffix.lower() != ".json":
        raise InputError(f"out={config.out}: the repaired poses of a scene are a nerfstudio file; give a name in .json")
    if not is_scene:
        check_splat_name(config.out)
    run.check_files(config.out)
    if is_scene:
        _repair_scene(path, config, run)
        return
    with run.step("read"):
        raw = read_raw(config.paths[0])
    with run.step("repair"):
        repaired, report = repair_splat(raw, config.fix)
        origin = float64_origin(repaired)
        gaussians = gaussians_from_raw(
            repaired, origin=origin, where=f"{config.paths[0]} after fix={','.join(config.fix)}"
        )
    run.results.update(report.to_dict(), path=str(config.out))
    with run.file(config.out), run.step("write"):
        save_splat(config.out, gaussians, origin=origin)
    run.print(*(f"{change.fix}: {change.count:,} rows {change.action}" for change in report.changes))
    run.print(f"{config.out}: {report.rows_after:,} of {report.rows_before:,} Gaussians")


MAX_ROUNDS = 10  # of repairing and checking again


def _repair_scene(path: Path, config: RepairConfig, run: Run) -> None:
    """Writes a transforms.json whose poses, depth and cameras fit, and checks that they do."""
    # Only scenes need Pillow and, for some depth sensors, torch.
    from gsencoder.data.check.agreement import repair_posed
    from gsencoder.data.check.scene_check import check_scene, findings_of, fit_of, is_decided
    from gsencoder.data.readers.transforms_json import transforms_of

    assert config.out is not None
    with run.step("read"):
        scene = load_scene(path, options=config.data)
        posed, _, _ = read_posed(path.absolute(), config.data)
        assert scene.views is not None
        assert posed is not None
    with run.step("check"):
        depth, matches = check_scene(scene.views, limit=config.views, track=run.track)
    findings = findings_of(scene.views, depth, matches)
    if not findings and not is_decided(depth, matches):
        raise InputError(f"{path}: too little to tell whether something is wrong, so there is nothing to repair")
    before, changes, repaired = fit_of(depth, matches), list[str](), posed
    # A view that is far astray may hide another one.
    for _ in range(MAX_ROUNDS):
        repaired, more = repair_posed(repaired, findings, depth.registration if depth is not None else None)
        changes += more
        content = transforms_of(repaired, config.out.parent)
        with run.step("check"):
            again = _load_back(content, config.out)
            assert again.views is not None
            depth, matches = check_scene(again.views, limit=config.views, track=run.track)
        findings = findings_of(again.views, depth, matches)
        if not findings or any(finding.view is None for finding in findings):
            break
    if findings:
        raise InputError(f"{path}: still wrong once repaired: {findings[0].message}; nothing was written")
    after = fit_of(depth, matches)
    run.results.update(path=str(config.out), changes=changes, agreement_before=before, agreement_after=after)
    with run.file(config.out), run.step("write"):
        write_json(config.out, content)
    run.print(*changes)
    outside = (
        "" if config.out.resolve().parent == path.resolve() else "; its files lie elsewhere: data.allow_outside=true"
    )
    run.print(
        f"{config.out}: {len(repaired.images):,} of {len(posed.images):,} views; {before:.0%} of what views share "
        f"agreed, {after:.0%} do{outside}"
    )


def _load_back(content: dict[str, Any], out: Path) -> Scene:
    """The scene of a transforms.json that is to stand at `out`, by a hidden file next to it."""
    partial = out.with_name(f".{out.stem}.partial-{secrets.token_hex(6)}.json")
    try:
        write_json(partial, content)
        return load_scene(partial, options=SceneConfig(allow_outside=True))
    finally:
        with suppress(OSError):
            partial.unlink()


def float64_origin(raw: RawSplat) -> Float64[np.ndarray, "3"] | None:
    """Integer coordinates near the middle of the splat if its positions need float64; None if float32 holds them."""
    if np.array_equal(raw.means, raw.means.astype(np.float32)):
        return None
    return np.floor(np.median(raw.means, axis=0))
