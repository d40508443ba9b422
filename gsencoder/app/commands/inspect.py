"""`gsencoder inspect PATH…`: what splats and scenes hold, and what is wrong with them, without changing them."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw
from rich.table import Table

from gsencoder.app.options import CommonConfig
from gsencoder.app.run import Run
from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, listed
from gsencoder.core.files import write_picture
from gsencoder.core.settings import option
from gsencoder.data.check.agreement import agreement_map
from gsencoder.data.check.epipolar import EpipolarCheck
from gsencoder.data.check.scene_check import DepthCheck
from gsencoder.data.labels.mesh import MeshInstances
from gsencoder.data.readers.masks import LabelFiles
from gsencoder.data.readers.posed import PosedImage, PosedImages
from gsencoder.data.scenes import (
    SceneConfig,
    distinct_paths,
    find_scenes,
    find_splat,
    has_views,
    load_scene,
    read_posed,
    scene_name,
)
from gsencoder.data.seeding.matches import epipolar_distances, fundamental_matrix
from gsencoder.data.splats.files import READABLE, read_raw
from gsencoder.data.splats.repair import SplatReport, inspect_splat
from gsencoder.data.up import Up, up_of_scene
from gsencoder.data.video import refuse_video
from gsencoder.infer.draw import contact_sheet, depth_picture
from gsencoder.types import Scene, Views
from gsencoder.types.orientation import turned
from gsencoder.types.scene import Selected


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectConfig(CommonConfig):
    """Settings of `inspect`."""

    paths: tuple[str, ...] = option(
        (), f"scenes with posed views, or splats: {READABLE}", metavar="PATH", required=True
    )
    out: Path | None = option(
        None, "folder for a summary.json with the same facts, and a picture of each scene's check", metavar="FOLDER"
    )
    check: bool = option(True, "hold the views of a scene against each other, which takes seconds")
    views: int = option(0, "largest number of views to hold against each other; 0 = 32 with depth, else 24", ge=0)
    data: SceneConfig = field(default_factory=SceneConfig)

    def __post_init__(self) -> None:
        CommonConfig.__post_init__(self)
        if self.views == 1:
            raise InputError("views: expected 0 or at least 2, got 1")


def run(config: InspectConfig, run: Run) -> None:
    """Reads each splat or scene, prints one table for each, and writes the summary if asked to."""
    if config.out is None:
        for path in _paths(config.paths):
            run.print(*_inspect(path, config, run, None), highlight=False)
        return
    with run.folder(config.out) as folder:
        reports = [_inspect(path, config, run, folder) for path in _paths(config.paths)]
    # What was written stays, also if the printed text is cut off.
    for lines in reports:
        run.print(*lines, highlight=False)


def _paths(words: tuple[str, ...]) -> tuple[Path, ...]:
    """Splat files and scenes; a folder of scenes stands for all of them."""
    chosen: list[Path] = []
    for path in map(Path, words):
        if not path.exists():
            # Not after all that stand before it were looked at.
            raise InputError(f"{path}: no such file")
        chosen += find_scenes([path]) if path.is_dir() and not (path / "meta.json").is_file() else [path]
    return distinct_paths(chosen)


def _inspect(path: Path, config: InspectConfig, run: Run, folder: Path | None) -> list[Table | str]:
    """What there is to say about a splat or a scene."""
    if path.exists() and has_views(path):
        return _inspect_scene(path, config, run, folder)
    refuse_video(path)
    source = find_splat(path) if path.is_dir() else path
    with run.step("read"):
        raw = read_raw(source)
    with run.step("inspect"):
        report = inspect_splat(raw)
    run.results.setdefault("splats", []).append({"path": str(path), **report.to_dict()})
    return [report_table(str(path), report)]


def _inspect_scene(path: Path, config: InspectConfig, run: Run, folder: Path | None) -> list[Table | str]:
    # Only scenes need Pillow and, for some depth sensors, torch.
    from gsencoder.data.check.scene_check import check_scene, findings_of, is_decided

    with run.step("read"):
        scene = load_scene(path, options=config.data)
        posed, _, layout = read_posed(path.absolute(), config.data)
        assert scene.views is not None
        assert posed is not None
    with run.step("facts"):
        up = up_of_scene(scene)
        facts = scene_facts(scene, posed, layout, up)
    lines: list[Table | str] = [str(path), scene_table(facts, up)]
    results: dict[str, Any] = {"path": str(path), **facts}
    if config.check:
        with run.step("check"):
            depth, matches = check_scene(scene.views, limit=config.views, track=run.track)
        findings = findings_of(scene.views, depth, matches)
        lines += check_lines(facts, depth, matches)
        lines += [f"wrong: {f'view {each.view}: ' if each.view is not None else ''}{each.message}" for each in findings]
        if not findings and (depth is not None or matches is not None):
            lines.append("nothing wrong was seen" if is_decided(depth, matches) else "too little to tell")
        results["check"] = check_results(depth, matches)
        results["findings"] = [asdict(finding) for finding in findings]
        if folder is not None:
            picture = f"{scene_name(path)}.png"
            if save_check_picture(folder / picture, scene.views, depth, matches):
                results["picture"] = picture
    run.results.setdefault("scenes", []).append(results)
    return lines


def report_table(path: str, report: SplatReport) -> Table:
    """A report as a table of two columns; defects say how many rows, and where the first of them are."""
    table = Table(title=path, title_justify="left", show_header=False)
    table.add_row("Gaussians", f"{report.count:,}")
    table.add_row("format", report.format)
    table.add_row("SH degree", str(report.sh_degree))
    for name, low, high in (
        ("extent", report.extent_min, report.extent_max),
        ("1st to 99th percentile", report.robust_min, report.robust_max),
    ):
        if low is not None and high is not None:
            table.add_row(name, " to ".join(_corners(low, high)))
    if report.median_scale is not None:
        table.add_row("median scale", f"{report.median_scale:.4g}")
    if report.opacity_quantiles:
        table.add_row("opacity", ", ".join(f"{float(q):.0%} {v:.3f}" for q, v in report.opacity_quantiles.items()))
    for defect in report.defects:
        first = ", ".join(map(str, defect.first_rows)) + (", …" if defect.count > len(defect.first_rows) else "")
        stops = "; stops loading" if defect.stops_loading else ""
        table.add_row(defect.name, f"{defect.count:,} rows ({first}){stops}")
    if report.unused:
        table.add_row("not used", ", ".join(report.unused))
    for finding in report.findings:
        table.add_row("wrong", finding)
    table.add_row("loads", "yes" if report.loadable else "no; see gsencoder repair")
    return table


def _corners(low: tuple[float, ...], high: tuple[float, ...]) -> list[str]:
    """The corners of a box, with four digits of its size also where it lies far from the origin."""
    size = max(max(high[axis] - low[axis] for axis in range(3)), 1e-30)
    decimals = max(3 - math.floor(math.log10(size)), 0)
    return [f"({', '.join(f'{round(value, decimals):.9g}' for value in corner)})" for corner in (low, high)]


MAX_ROWS = 4  # Views in the picture
MAX_DEPTH_IMAGES = 24  # Depth images, evenly spaced, that are read for their coverage and range
MAX_MASKS = 8  # Photographs, evenly spaced, whose empty pixels are counted
GOOD, BAD, NOTHING = (44, 160, 44), (214, 39, 40), (64, 64, 64)
"""Colors of pixels whose depth agrees with other views, of those whose does not, and of those that none sees."""


def scene_facts(scene: Scene, posed: PosedImages, layout: str, up: Up | None) -> dict[str, Any]:
    """What a loaded scene with views holds, as JSON values; some of its depth images are read. `posed` are the same
    views as their files describe them."""
    views = scene.views
    assert views is not None
    cameras, names = views.cameras, set(views.names)
    images = [image for image in posed.images if image.name in names]
    focal = cameras.Ks[:, 0, 0]
    fields = [
        float(np.rad2deg(2 * np.median(np.arctan(size / 2 / cameras.Ks[:, axis, axis]))))
        for axis, size in enumerate((cameras.widths, cameras.heights))
    ]
    sizes = Counter(zip(cameras.widths.tolist(), cameras.heights.tolist(), strict=True)).most_common()
    extent = np.ptp(cameras.centers, axis=0) if len(cameras) else np.zeros(3)
    unused = [f"folder {name}" for name in posed.unused_folders(scene.folder, layout)]
    empty = None
    if views.empty is not None:
        empty = float(np.mean([views.empty[int(row)].mean() for row in even_indices(len(views), MAX_MASKS)]))
    return {
        "layout": layout,
        "views": len(views),
        "sizes": [[*size, count] for size, count in sizes],
        "models": dict(Counter(image.camera.model for image in images).most_common()),
        "focal": [float(focal.min()), float(focal.max())],
        "depth": None if views.depths is None else _depth_facts(views.depths, images),
        "masks": views.masks is not None,
        "empty": empty,
        "points": 0 if scene.sfm_points is None else len(scene.sfm_points),
        "objects": len(scene.objects),
        "instances": _instances_source(views),
        "metres_per_unit": scene.metres_per_unit,
        "up": up,
        "missing": _missing(scene, views, up),
        "unused": [*posed.unused, *unused],
        "field_of_view": fields,
        "camera_extent": extent.tolist(),
    }


def _instances_source(views: Views) -> str:
    maps = views.instances
    while isinstance(maps, Selected):
        maps = maps.items
    if isinstance(maps, LabelFiles) and maps.archive is not None:
        return f"pictures in {maps.archive.name}"
    if isinstance(maps, MeshInstances):
        return "drawn from the labeled mesh"
    return "" if maps is None else "pictures"


def _depth_facts(depths: Sequence[np.ndarray], images: Sequence[PosedImage]) -> dict[str, Any]:
    """The share of the pixels with depth, its 1st and 99th percentile, and how the sensor differs."""
    measured_pixels, pixels, values = 0, 0, []
    for view in even_indices(len(depths), MAX_DEPTH_IMAGES):
        depth = depths[int(view)]
        measured = depth[depth > 0]
        measured_pixels, pixels = measured_pixels + len(measured), pixels + depth.size
        values.append(measured[:: max(1, len(measured) // 10_000)])
    sample = np.concatenate(values)
    near, far = np.percentile(sample, (1, 99)) if len(sample) else (float("nan"),) * 2
    with_depth = [image for image in images if image.depth is not None]
    return {
        "views": len(with_depth),
        "coverage": measured_pixels / max(1, pixels),
        "near": float(near),
        "far": float(far),
        "sensor": "; ".join(sorted({_sensor(image) for image in with_depth} - {""})[:2]),
    }


def _sensor(image: PosedImage) -> str:
    """How a depth camera differs from the photograph's, in words."""
    parts = []
    if image.depth_camera is not None and image.depth_camera.params[0] != image.camera.params[0]:
        parts.append(f"f = {image.depth_camera.params[0]:g} (photographs {image.camera.params[0]:g})")
    if image.depth_from_color is not None:
        shift = float(np.linalg.norm(image.depth_from_color[:3, 3]))
        parts.append(f"{shift:.3g} units from the camera")
    return ", ".join(parts)


def _missing(scene: Scene, views: Views, up: Up | None) -> list[str]:
    """What is not there, and what follows from it."""
    gaps = []
    if views.depths is None and scene.sfm_points is None:
        gaps.append("depth and points: seeds are triangulated from the photographs")
    elif views.depths is None:
        gaps.append("depth: visibility is tested against rendered depth, and seeds come from the points")
    if len(views) > 1 and not np.ptp(views.cameras.centers, axis=0).any():
        gaps.append("baselines: all cameras stand in one place, so that photographs alone say nothing about depth")
    if scene.metres_per_unit is None:
        gaps.append("unit of length: sizes are in world units (metres_per_unit=)")
    if up is None or up.source != "files":
        gaps.append("up: it is estimated" if up is not None else "up: boxes have any orientation")
    return gaps


def scene_table(facts: dict[str, Any], up: Up | None) -> Table:
    """The facts of a scene as a table of two columns."""
    table, metres = Table(show_header=False), facts["metres_per_unit"]
    unit = "m" if metres == 1 else "units"
    sizes = ", ".join(f"{width}×{height} ({count})" for width, height, count in facts["sizes"][:4])
    low, high = facts["focal"]
    focal = f"{low:.1f}" if high - low < 0.05 else f"{low:.1f} to {high:.1f}"
    across, down = facts["field_of_view"]
    rows = [
        ("layout", facts["layout"]),
        ("views", f"{facts['views']:,}: {sizes}{', …' if len(facts['sizes']) > 4 else ''}"),
        ("cameras", f"{', '.join(facts['models'])}; f = {focal} pixels, {across:.0f}° × {down:.0f}°"),
        ("cameras spread over", " × ".join(f"{length:.3g}" for length in facts["camera_extent"]) + f" {unit}"),
    ]
    if depth := facts["depth"]:
        share = f"{depth['views']:,} of {facts['views']:,} views, {depth['coverage']:.0%} of the pixels"
        rows.append(("depth", f"{share}, {depth['near']:.3g} to {depth['far']:.3g} {unit}"))
        if depth["sensor"]:
            sensor = f"not registered in the files: {depth['sensor']}; carried over on load"
            rows.append(("depth sensor", sensor))
    if facts["masks"]:
        empty = facts["empty"]
        rows.append(("masks", "yes" + (f"; {empty:.0%} of the pixels show that nothing is there" if empty else "")))
    if facts["points"]:
        rows.append(("points", f"{facts['points']:,}"))
    if facts["objects"]:
        rows.append(("objects", f"{facts['objects']:,} with boxes"))
    if facts["instances"]:
        rows.append(("instance maps", facts["instances"]))
    rows.append(("unit", "unknown" if metres is None else f"{metres:g} m"))
    rows.append(("up", "unknown" if up is None else up.describe()))
    rows += [("missing", line) for line in facts["missing"]]
    if facts["unused"]:
        rows.append(("not used", ", ".join(facts["unused"])))
    for row in rows:
        table.add_row(*row)
    return table


def check_lines(facts: dict[str, Any], depth: DepthCheck | None, matches: EpipolarCheck | None) -> list[str]:
    """The figures of the checks, a line each."""
    lines = []
    if depth is not None:
        agreement = depth.given
        if depth.comparable:
            lines.append(
                f"depth of {len(depth.views)} of {facts['views']:,} views carried into each other: "
                f"{agreement.share:.0%} agree within 2 % where seen ({agreement.compared:,} comparisons); median "
                f"offset {agreement.offset:+.2%}"
            )
        else:
            lines.append("depth: by their poses no two views see the same place, so it cannot be compared")
        if np.isfinite(depth.color):
            lines.append(f"colors at the same places correlate by {depth.color:.2f}")
        if depth.registration is not None and np.isfinite(depth.registration.given):
            fit = depth.registration
            lines.append(
                f"details of the photographs correlate by {fit.given:.2f} with the given camera, best by "
                f"{fit.best:.2f} with a focal length of {fit.focal_factor * facts['focal'][0]:.0f} pixels"
            )
    if matches is not None:
        if matches.pairs:
            figures = (
                f"{matches.share:.0%} within 2 pixels of their epipolar lines, {matches.error:.2f} pixels on average"
            )
            lines.append(
                f"{matches.matches:,} matches of {matches.pairs} pairs of {len(matches.views)} of {facts['views']:,} "
                f"views, in pictures of at most 640 pixels{f': {figures}' if matches.decided else ''}"
            )
            if matches.decided and matches.unmatched:
                lines.append(f"too few matches to tell whether these fit: {listed(matches.unmatched)}")
        else:
            lines.append("photographs: no two of the views that were looked at have features in common")
    if depth is None and matches is None:
        lines.append("one view alone has nothing to be held against")
    return lines


def check_results(depth: DepthCheck | None, matches: EpipolarCheck | None) -> dict[str, Any]:
    """The figures of the checks as JSON values."""
    results: dict[str, Any] = {}
    if depth is not None:
        results["depth"] = {
            "views": len(depth.views),
            "comparisons": depth.given.compared,
            "share": depth.given.share,
            "offset": depth.given.offset,
            "best_share": depth.best.share,
            "color_correlation": depth.color,
        }
        if depth.registration is not None:
            fit = ("focal_factor", "shift", "given", "best")
            results["registration"] = {name: getattr(depth.registration, name) for name in fit}
    if matches is not None:
        results["matches"] = {
            "views": len(matches.views),
            **{name: getattr(matches, name) for name in ("pairs", "matches", "share", "decided", "unmatched")},
            "error_pixels": matches.error,
            "best_error_pixels": matches.best_error,
        }
    return results


def save_check_picture(path: Path, views: Views, depth: DepthCheck | None, matches: EpipolarCheck | None) -> bool:
    """Draws what the checks saw; returns whether there was anything to draw.

    Of depth: photograph, depth and agreement of up to four views. Of matches: the pair that fits its poses worst, its
    matches green where they lie on their epipolar lines, and red where they do not.
    """
    orientations = views.orientations or (1,) * len(views)
    if depth is not None and depth.comparable:
        pictures, titles = [], []
        for index in even_indices(len(depth.views), MAX_ROWS):
            view = int(depth.views[index])
            share, orientation = agreement_map(depth.depth, int(index)), orientations[view]
            if views.images is not None:
                pictures.append(turned(views.images[view], orientation))
                titles.append(views.names[view])
            measured = (depth_picture(depth.depth.depths[index]), _agreement_picture(share))
            pictures += [turned(picture, orientation) for picture in measured]
            shares = share[np.isfinite(share)]
            titles += [
                "depth",
                f"agrees with other views: {shares.mean():.0%}" if len(shares) else "no other view sees it",
            ]
        sheet = contact_sheet(pictures, titles, columns=3 if views.images is not None else 2)
    elif matches is not None and matches.worst is not None and views.images is not None:
        pair, cameras = matches.worst, matches.cameras
        distances = epipolar_distances(
            fundamental_matrix(cameras, pair.first, pair.second), pair.first_pixels, pair.second_pixels
        )
        pictures, titles = [], []
        for row, pixels in ((pair.first, pair.first_pixels), (pair.second, pair.second_pixels)):
            view = int(matches.views[row])
            size = int(cameras.widths[row]), int(cameras.heights[row])
            pictures.append(turned(_dots(views.images[view], size, pixels, distances), orientations[view]))
            titles.append(views.names[view])
        sheet = contact_sheet(pictures, titles, columns=2, width=640)
    else:
        return False
    write_picture(path, sheet)
    return True


def _agreement_picture(share: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    """Green where other views agree, red where they do not, grey where none sees the place."""
    mix = np.nan_to_num(share)[..., None]
    picture = mix * np.array(GOOD) + (1 - mix) * np.array(BAD)
    return np.where(np.isfinite(share)[..., None], picture, np.array(NOTHING)).astype(np.uint8)


def _dots(
    image: UInt8[np.ndarray, "H W 3"], size: tuple[int, int], pixels: np.ndarray, distances: np.ndarray
) -> UInt8[np.ndarray, "h w 3"]:
    picture = Image.fromarray(image).resize(size, Image.Resampling.BOX)
    draw = ImageDraw.Draw(picture)
    for (u, v), distance in zip(pixels.tolist(), distances.tolist(), strict=True):
        mix = min(1.0, distance / 4.0)
        color = tuple(round((1 - mix) * good + mix * bad) for good, bad in zip(GOOD, BAD, strict=True))
        draw.ellipse((u - 3, v - 3, u + 3, v + 3), fill=color, outline=(0, 0, 0))
    return np.asarray(picture)
