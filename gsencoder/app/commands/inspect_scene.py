"""What `gsencoder inspect` shows of a scene with posed views: a table, findings and a picture."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw
from rich.table import Table

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import listed
from gsencoder.core.files import write_picture
from gsencoder.data.check.agreement import agreement_map
from gsencoder.data.check.epipolar import EpipolarCheck
from gsencoder.data.check.findings import Finding
from gsencoder.data.check.scene_check import DepthCheck
from gsencoder.data.facts import SceneFacts
from gsencoder.data.seeding.matches import epipolar_distances, fundamental_matrix
from gsencoder.infer.draw import contact_sheet, depth_picture
from gsencoder.types import Views
from gsencoder.types.orientation import turned

MAX_ROWS = 4
"""Views in the picture."""
GOOD, BAD, NOTHING = (44, 160, 44), (214, 39, 40), (64, 64, 64)
"""Colors of pixels whose depth agrees with other views, of those whose does not, and of those that none sees."""


def scene_table(facts: SceneFacts) -> Table:
    """The facts of a scene as a table of two columns."""
    table = Table(show_header=False)
    table.add_row("layout", facts.layout)
    sizes = ", ".join(f"{width}×{height} ({count})" for (width, height), count in list(facts.sizes.items())[:4])
    table.add_row("views", f"{facts.views:,}: {sizes}{', …' if len(facts.sizes) > 4 else ''}")
    low, high = facts.focal
    focal = f"{low:.1f}" if high - low < 0.05 else f"{low:.1f} to {high:.1f}"
    table.add_row(
        "cameras",
        f"{', '.join(facts.models)}; f = {focal} pixels, {facts.field[0]:.0f}° × {facts.field[1]:.0f}°",
    )
    unit = "m" if facts.metres_per_unit == 1 else "units"
    table.add_row("cameras spread over", " × ".join(f"{length:.3g}" for length in facts.spread) + f" {unit}")
    if facts.depth is not None:
        depth = facts.depth
        table.add_row(
            "depth",
            f"{depth.views:,} of {facts.views:,} views, {depth.coverage:.0%} of the pixels, "
            f"{depth.near:.3g} to {depth.far:.3g} {unit}",
        )
        if depth.sensor:
            table.add_row("depth sensor", f"not registered in the files: {depth.sensor}; carried over on load")
    if facts.masks:
        empty = "" if facts.empty is None else f"; {facts.empty:.0%} of the pixels show that nothing is there"
        table.add_row("masks", f"yes{empty}")
    if facts.points:
        table.add_row("points", f"{facts.points:,}")
    if facts.objects:
        table.add_row("objects", f"{facts.objects:,} with boxes")
    if facts.instances:
        table.add_row("instance maps", facts.instances)
    table.add_row("unit", "unknown" if facts.metres_per_unit is None else f"{facts.metres_per_unit:g} m")
    table.add_row("up", "unknown" if facts.up is None else facts.up.describe())
    for line in facts.missing:
        table.add_row("missing", line)
    if facts.unused:
        table.add_row("not used", ", ".join(facts.unused))
    return table


def check_lines(facts: SceneFacts, depth: DepthCheck | None, matches: EpipolarCheck | None) -> list[str]:
    """The figures of the checks, a line each."""
    lines = []
    if depth is not None:
        agreement = depth.stated
        if depth.comparable:
            near, far = depth.offsets
            lines.append(
                f"depth of {len(depth.views)} of {facts.views:,} views carried into each other: {agreement.share:.0%} "
                "agree "
                f"within 2 % where seen ({agreement.compared:,} comparisons); median offset "
                f"{_percent(agreement.offset, sign=True)}"
            )
            lines.append(f"median offset of neighbors {_percent(near)}, of views far apart {_percent(far)}")
        else:
            lines.append("depth: by their poses no two views see the same place, so it cannot be compared")
        if np.isfinite(depth.color):
            lines.append(f"colors at the same places correlate by {depth.color:.2f}")
        if depth.registration is not None and np.isfinite(depth.registration.stated):
            fit = depth.registration
            lines.append(
                f"details of the photographs correlate by {fit.stated:.2f} with the stated camera, best by "
                f"{fit.best:.2f} with a focal length of {fit.focal_factor * facts.focal[0]:.0f} pixels"
            )
    if matches is not None:
        if matches.pairs:
            lines.append(
                f"{matches.matches:,} matches of {matches.pairs} pairs of {len(matches.views)} of {facts.views:,} "
                f"views: {matches.share:.0%} within 2 pixels of their epipolar lines, {matches.error:.2f} pixels on "
                "average (pictures of at most 640 pixels)"
            )
            if matches.decided and matches.unmatched:
                lines.append(f"too few matches to tell whether these fit: {listed(matches.unmatched)}")
        else:
            lines.append("photographs: no two of the views that were looked at have features in common")
    if depth is None and matches is None:
        lines.append("one view alone has nothing to be held against")
    return lines


def _percent(value: float, *, sign: bool = False) -> str:
    if not np.isfinite(value):
        return "unknown"
    return f"{value:+.2%}" if sign else f"{value:.2%}"


def finding_line(finding: Finding) -> str:
    """A finding as one line."""
    return f"view {finding.view}: {finding.message}" if finding.view is not None else finding.message


def check_results(depth: DepthCheck | None, matches: EpipolarCheck | None) -> dict[str, Any]:
    """The figures of the checks as JSON values."""
    results: dict[str, Any] = {}
    if depth is not None:
        results["depth"] = {
            "views": len(depth.views),
            "comparisons": depth.stated.compared,
            "share": depth.stated.share,
            "offset": depth.stated.offset,
            "offset_near": depth.offsets[0],
            "offset_far": depth.offsets[1],
            "best_share": depth.best.share,
            "color_correlation": depth.color,
        }
        if depth.registration is not None:
            results["registration"] = {
                "focal_factor": depth.registration.focal_factor,
                "shift": depth.registration.shift.tolist(),
                "given": depth.registration.stated,
                "best": depth.registration.best,
            }
    if matches is not None:
        results["matches"] = {
            "views": len(matches.views),
            "pairs": matches.pairs,
            "matches": matches.matches,
            "share": matches.share,
            "error_pixels": matches.error,
            "best_error_pixels": matches.best_error,
            "decided": matches.decided,
            "unmatched": list(matches.unmatched),
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
