"""What the catalogue says of lights: the rows of `unirender lights`, ready for JSON."""

import hashlib
from typing import Any

import numpy as np

from unirender.color import luminance
from unirender_reference.lights.bundled import catalogue
from unirender_reference.lights.draw import SHARES
from unirender_reference.lights.light import Light, mean_luminance

KINDS = {
    "bundled": "a map of the split, turned by whole columns, every other time mirrored, 15 % tilted by up to 20 deg",
    "softboxes": "1 to 5 rectangular or round area lights with soft edges, warm to cool, in a dim room",
    "sunsky": "Mitsuba sunsky: sun 4 to 80 deg high, turbidity 1.5 to 9, disc widened to 4 to 12 deg, over a ground",
    "gradient": "a colour gradient from side to side with 1 to 4 broad coloured lobes",
    "constant": "one colour from everywhere",
}
UNSAID = (
    "source",
    "seed",
    "split",
    "kind",
    "rule",
    "license",
    "scale",
    "skipped",
    "file",
    "yaw_columns",
    "map_columns",
    "mirrored",
)  # in `about`


def light_row(light: Light) -> dict[str, Any]:
    """Name, size, figures and provenance of a light; of a bundled map also its row of the catalogue.

    `mean_luminance` is over the sphere by solid angle, `peak_ratio` the largest luminance over that mean, `sha256` that
    of the float32 texels in row order. `twins` is the name that maps of several packages carry: they may show the same
    place.
    """
    mean = mean_luminance(light.environment, light.name)
    texels = np.ascontiguousarray(light.environment, "<f4").tobytes()
    row = {
        "name": light.name,
        "about": about(light),
        "size": list(light.environment.shape[:2]),
        "mean_luminance": mean,
        "peak_ratio": float(luminance(light.environment).max()) / mean,
        "sha256": hashlib.sha256(texels).hexdigest(),
        "provenance": dict(light.provenance),
    }
    if light.name in catalogue():
        row |= {key: catalogue()[light.name][key] for key in ("package", "source", "license", "source_sha256")}
        row["twins"] = twins(light.name)
    return row


def about(light: Light) -> str:
    """A line on how a light was made."""
    if light.name in catalogue():
        shared = twins(light.name)
        return ", ".join(filter(None, [catalogue()[light.name]["license"], shared and f"twins {shared}"]))
    known = light.provenance
    shown = [f"{key} {value}" for key, value in known.items() if key not in UNSAID]
    return ", ".join([known.get("kind") or known.get("rule", "").split(":")[0], *shown])


def twins(name: str) -> str | None:
    """The name that a bundled map shares with one of another package: city, forest, ...; None for most."""
    place = name.split("-", 1)[1]
    return place if sum(other.split("-", 1)[1] == place for other in catalogue()) > 1 else None


def kind_rows() -> list[dict[str, Any]]:
    """What `make_light` draws from: kind, share of the seeds, parameters. The same in both splits, by other seeds."""
    return [{"kind": kind, "share": share, "what": KINDS[kind]} for kind, share in SHARES.items()]
