"""What the model's commands refuse among their options, and what they say of pictures and maps: a notice to the user,
a fact for `meta.json`, or both. Light to import.
"""

import dataclasses
from typing import TYPE_CHECKING, Any

from unirender.command_line.input_picture import MANY_CLIPPED
from unirender.errors import UsageError
from unirender.system.notices import notice
from unirender.system.wording import counted

if TYPE_CHECKING:
    import numpy as np

    from unirender.intrinsics import Intrinsics
    from unirender.pictures import Picture
    from unirender.pipelines.unirender_pipeline import UniRenderPipeline

MAX_STOPS = 32
MANY_TILES = 500  # from which a notice is due
IMAGINED = ("albedo", "specular", "diffuse", "environment")  # by the network, where they are not given


def check_stops(stops: float | None) -> None:
    """Looks at a number of stops.

    Raises:
        UsageError: it is none that a light could be changed by.
    """
    if stops is not None and not abs(stops) <= MAX_STOPS:
        raise UsageError(f"--exposure {stops}: expected stops between -{MAX_STOPS} and {MAX_STOPS}")


def parts_left_out(mask: "np.ndarray | None", side: int) -> dict[str, str]:
    """A remark, by kind, where parts of a mask are so small that a network looks only at what is beside them.

    Args:
        mask: coverage [h w 1].
        side: of the network's square, pixels.
    """
    from unirender.pipelines.framing import FAINT, STRAY, Frame

    if mask is None:
        return {}
    beside = int(((mask > FAINT) & (Frame.around(mask, side).seen(mask) == 0)).sum())
    if not beside:
        return {}
    return {
        "parts": f"left out as stray: {counted(beside, 'pixel')} of the mask, in parts away from the object, "
        f"together less than {STRAY:.1%} of it; to have their maps, give them a mask of their own"
    }


def frame_remarks(mask: "np.ndarray", side: int, tile: bool) -> dict[str, str]:
    """Remarks, by kind, on how a picture that is taken apart sits in a network's square.

    Args:
        mask: coverage [h w 1].
        side: of the square, pixels.
        tile: whether the detail of tiles is asked for.
    """
    from unirender.pipelines.framing import Frame
    from unirender.pipelines.tiling import tiles_of

    found = parts_left_out(mask, side)
    if tile and (seen := Frame.around(mask, side).shown) <= side:
        found["tile"] = (
            f"--tile adds nothing: the part of the picture that the network looks at has {seen} pixels along a side, "
            f"no more than its own {side}"
        )
    elif tile and (count := len(tiles_of(mask, side))) > MANY_TILES:
        found["tile"] = (
            f"--tile: {count} tiles of {side} pixels, each of which takes about as long as a picture of that size; a "
            "smaller picture or a larger --size has fewer"
        )
    return found


def with_frame_remarks(picture: "Picture", side: int, tile: bool) -> "Picture":
    """A picture with those remarks among its others, and a notice of each of all: nothing is refused any more that
    would make them moot.

    Args:
        picture: with a mask.
        side: as for `frame_remarks`.
        tile: likewise.
    """
    assert picture.mask is not None, "what is read for a command has one"
    remarks = {**picture.remarks, **frame_remarks(picture.mask, side, tile)}
    for remark in remarks.values():
        notice(remark)
    return dataclasses.replace(picture, remarks=remarks)


def overflow(pipeline: "UniRenderPipeline", intrinsics: "Intrinsics") -> dict[str, Any]:
    """For `meta.json`: which HDR maps exceed the brightest that the network was taught, and by how many values."""
    found = pipeline.overflow(intrinsics)
    return {"above_x_max": {name: dataclasses.asdict(over) for name, over in found.items()}}


def missing_maps(intrinsics: "Intrinsics", new_light: bool) -> dict[str, Any]:
    """For `meta.json`: which maps a rendering gets from elsewhere than what is given; a notice where nobody asked.

    Args:
        intrinsics: as they are given.
        new_light: whether a light beside them takes the place of their specular, diffuse and environment.
    """
    from unirender.pipelines.rendered_maps import DERIVABLE, to_derive, with_mask

    derived = DERIVABLE if new_light else tuple(name for name in DERIVABLE if name in to_derive(intrinsics))
    lit = (*DERIVABLE, "environment") if new_light else derived
    imagined = [name for name in IMAGINED if name not in (*intrinsics.present, *lit)]
    facts: dict[str, Any] = {"imagined": imagined, "derived": list(derived)}
    said = [f"the network imagines {', '.join(imagined)}"] if imagined else []
    if derived and not new_light:
        said.append(f"{' and '.join(derived)} {'follow' if len(derived) > 1 else 'follows'} from the environment")
    if intrinsics.mask is None:
        whole = bool(with_mask(intrinsics).require("mask")["mask"].all())
        facts["mask_from"] = "frame" if whole else "normal"
        said.append("the mask is the whole frame" if whole else "the mask is where the normal is not 0")
    if said:
        notice(f"in place of maps that are missing: {'; '.join(said)}")
    return facts


def normals_away(intrinsics: "Intrinsics") -> dict[str, Any]:
    """For `meta.json`: the share of the covered normals that face away from the camera; the pipeline tells of many.

    Args:
        intrinsics: with a mask.
    """
    from unirender.pipelines.rendered_maps import facing_away

    if intrinsics.normal is None:  # what needs it says so
        return {}
    return {"facing_away": facing_away(intrinsics)}


def at_white(image_linear: "np.ndarray", mask: "np.ndarray | None") -> dict[str, Any]:
    """For `meta.json`: the share of a rendering's pixels at display white, where the network's range ends; a notice
    where there are many.

    Args:
        image_linear: premultiplied.
        mask: its coverage.
    """
    from unirender.color import image_srgb, unpremultiply
    from unirender.pictures import Picture

    straight = image_linear if mask is None else unpremultiply(image_linear, mask)
    share = Picture(image_srgb(straight), mask, "").clipped
    if share > MANY_CLIPPED:
        notice(f"{share:.0%} of the object's pixels come out at display white, where what the network renders ends")
    return {"at_white": share}
