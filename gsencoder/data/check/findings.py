"""What can be wrong with the files of a scene, and how it is said."""

from dataclasses import dataclass

ADVICE = {
    "axes": "the poses are in OpenGL's camera axes where OpenCV's are expected, or the reverse",
    "inverse": "the matrices are cam_from_world where world_from_cam is expected, or the reverse",
    "inverse and axes": "the matrices are the inverse of what is expected, in the other camera axes",
    "order": "the poses belong to other photographs: each is that of the photograph {factor:+.0f} places away",
    "ray length": "depth is the length of the ray where the coordinate z is expected",
    "depth scale": "the depth scale is wrong: depths should be {factor:.4g} times as large",
    "depth focal length": "depth has the focal length of another sensor: {factor:.4g} times the stated one",
    "focal length": "the focal length of the photographs is {factor:.4g} times the stated one",
    "picture size": "the intrinsics are those of pictures of another size: times {factor:.4g} they would fit these",
}
"""Causes that concern all views."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Something that is wrong.

    Attributes:
        cause: a key of `ADVICE`, "color registration", "stray view", "other picture", "photographs" or
            "unknown".
        message: for people.
        view: name of the view, if it is one alone.
        factor: of the depth scale or a focal length, or how many places the poses are moved by, where the cause has
            one.
    """

    cause: str
    message: str
    view: str | None = None
    factor: float | None = None
