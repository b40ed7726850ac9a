"""What the entries of an env mean: unit, order and frame, for whoever runs a policy elsewhere.

An env says it by an attribute `meanings`, a mapping from the name of an entry (with points if it is
nested), or `action`, to such a text or mapping. A Gymnasium env may have the attribute too. Nothing
else reads it: it ends up in the contract of an exported policy.
"""

from collections.abc import Mapping
from typing import Any

FIELDS = ("unit", "meaning", "bounds", "padding", "frame")
CAR = "car: x ahead, y to the left, the car at the origin"


def meanings_of(env: Any) -> dict[str, dict[str, str]]:
    """Return what an env says about its entries, and about its action.

    Args:
        env: without transforms.

    Raises:
        ValueError: for what is neither a text nor a mapping with some of `FIELDS`.
    """
    given = getattr(env, "meanings", None) or {}
    return {str(name): meaning(str(name), value) for name, value in dict(given).items()}


def meaning(name: str, value: Any) -> dict[str, str]:
    """Return a meaning as a mapping.

    Args:
        value: a text, or a mapping with some of `FIELDS`; else a `ValueError`.
    """
    if isinstance(value, str):
        return {"meaning": value}
    if not isinstance(value, Mapping) or not set(value) <= set(FIELDS):
        raise ValueError(
            f"meanings.{name}={value!r} must be a text, or a mapping with some of "
            f"{', '.join(FIELDS)}"
        )
    return {str(field): str(text) for field, text in value.items()}


def of_cones(sight: float, max_steering: float, scale: float = 1.0) -> dict[str, dict[str, str]]:
    """Return the meanings of the entries that every world with cones has.

    Args:
        sight: m, range of view.
        max_steering: degrees of an action of 1.
        scale: factor by which the lengths of the world are larger than real ones.
    """
    metre = "m" if scale == 1.0 else f"m, multiplied by {scale:g}"
    return {
        "observation": {
            "unit": f"distance: -1 is 0 m and 1 is {sight:g} {metre}; bearing: 1 is 120 degrees",
            "meaning": "five samples of the estimated left boundary, then five of the right one, "
            "nearest first, each as distance and bearing: r1, theta1, ..., r10, theta10; bearings "
            "to the left are positive",
            "padding": "zeros for a side that was never estimated in this episode",
            "frame": CAR,
        },
        "cones": {
            "unit": metre,
            "meaning": "visible cones: side (left, right), cone (nearest first), coordinate (x, y)",
            "padding": "zeros behind the last cone of a side",
            "frame": CAR,
        },
        "cone_count": {"unit": "1", "meaning": "number of real cones of each side: left, right"},
        "steering": {
            "unit": f"1 is {max_steering:g} degrees",
            "meaning": "steering angle in force, the last action; left is positive",
        },
        "motion": {
            "unit": f"{metre}, {metre}, radians",
            "meaning": "way since the last observation: ahead, to the left, turn to the left; "
            "zeros in the first step of an episode",
            "frame": CAR,
        },
        "action": {
            "unit": f"1 is {max_steering:g} degrees",
            "meaning": "steering angle; left is positive",
            "frame": CAR,
        },
    }
