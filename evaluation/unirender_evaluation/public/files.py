"""What the readers of public test sets share: what a folder lacks, and its pictures and arrays as linear numbers."""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float
from PIL import Image

from unirender.errors import UnirenderError
from unirender.picture_files.display_files import srgb_values, stored_values
from unirender.system.wording import counted

T = TypeVar("T")

MOST_PROBLEMS = 40  # lines of an error: a folder in another layout has thousands


class PublicSetError(UnirenderError):
    """A folder that is not the set it is said to be; `problems` has a line for each reason."""

    def __init__(self, name: str, problems: Sequence[str]) -> None:
        shown = list(problems[:MOST_PROBLEMS])
        more = [f"and {len(problems) - len(shown)} more"] if len(problems) > len(shown) else []
        count = counted(len(problems), "problem")
        super().__init__("\n".join([f"{name}: {count}, nothing was run", *shown, *more]))
        self.problems = tuple(problems)


def need_folder(path: Path, name: str, layout: str) -> None:
    """Raises `PublicSetError` where the path is no folder."""
    if not path.is_dir():
        raise PublicSetError(name, [f"{path}: no such folder, expected {layout}"])


def missing_files(paths: Iterable[Path], what: str) -> Iterator[str]:
    """A line for each path that is no file."""
    for path in paths:
        if not path.is_file():
            yield f"{path}: no such file, expected {what}"


def parsed_json(path: Path, parse: Callable[[Any], T], expected: str) -> T:
    """What `parse` makes of a JSON file.

    Args:
        path: of the file.
        parse: of its content; a name that is missing or a value of another kind may fail in it.
        expected: the layout, for the message.

    Raises:
        UnirenderError: no readable file, another layout, or what `parse` refuses; the file is named.
    """
    expected = f"expected {expected}"
    try:
        return parse(json.loads(path.read_text(encoding="utf-8")))
    except UnirenderError as error:
        raise UnirenderError(f"{path}: {error}") from None
    except OSError as error:
        raise UnirenderError(f"{path}: cannot be read ({error.strerror}), {expected}") from error
    except KeyError as error:
        raise UnirenderError(f"{path}: {error} is missing, {expected}") from None
    except (TypeError, ValueError, AttributeError, RecursionError) as error:
        raise UnirenderError(f"{path}: not readable ({error}), {expected}") from None


def image_size(path: Path) -> tuple[int, int]:
    """Rows and columns of a picture, from its header.

    Raises:
        UnirenderError: no readable picture.
    """
    try:
        with Image.open(path) as file:
            width, height = file.size
    except (OSError, ValueError, SyntaxError) as error:
        raise UnirenderError(f"{path}: not a readable picture ({error}), expected PNG or JPG") from error
    return height, width


def read_display(path: Path, channels: int) -> Float[np.ndarray, "h w c"]:
    """Values in [0, 1] of a PNG or JPG, alpha dropped; grey is the mean of the channels.

    Raises:
        UnirenderError: no readable picture.
    """
    values = stored_values(path)[..., :3]
    return values if channels == 3 else values.mean(axis=-1, keepdims=True, dtype=np.float64).astype(np.float32)


def read_photograph(path: Path) -> Float[np.ndarray, "h w 3"]:
    """Display values of a photograph, alpha dropped; in sRGB, whatever its ICC profile says.

    Raises:
        UnirenderError: no readable picture.
    """
    return srgb_values(path)[..., :3]


def read_array(path: Path, channels: int) -> Float[np.ndarray, "h w c"]:
    """A map of a NumPy file, `[h w]` or `[h w c]`, of floating-point values.

    Raises:
        UnirenderError: no such array, another number of channels, integers, or values that are not finite.
    """
    try:
        found = np.load(path, allow_pickle=False)
    except Exception as error:  # NumPy raises half a dozen kinds for a damaged file
        raise UnirenderError(f"{path}: not a readable NumPy array ({error!s:.200}); copy it again") from error
    value = found[..., None] if getattr(found, "ndim", 0) == 2 else found
    if getattr(value, "ndim", 0) != 3 or value.shape[-1] != channels or value.dtype.kind not in "fiu":
        shape = getattr(found, "shape", type(found).__name__)
        raise UnirenderError(f"{path}: got an array of {shape}, expected numbers of (h, w, {channels})")
    if value.dtype.kind != "f":
        raise UnirenderError(
            f"{path}: got integers ({value.dtype}) of {found.shape}, expected floating-point values in the map's own "
            "unit"
        )
    if not np.isfinite(value).all():
        raise UnirenderError(f"{path}: has NaN or infinite values, expected finite ones")
    return value.astype(np.float32)


def block_mean(value: Float[np.ndarray, "h w c"], width: int, name: str) -> Float[np.ndarray, "h2 w2 c"]:
    """Means over square blocks, so many that `width` columns are left.

    Raises:
        UnirenderError: the size is no multiple.
    """
    side, rest = divmod(value.shape[1], width)
    if rest or not side or value.shape[0] % side:
        got = f"{value.shape[1]} x {value.shape[0]}"
        raise UnirenderError(f"{name}: is {got} pixels, expected a multiple of {width} columns; pass --resolution")
    height = value.shape[0] // side
    return value.reshape(height, side, width, side, -1).mean(axis=(1, 3), dtype=np.float64).astype(np.float32)


def shrunk(linear: Float[np.ndarray, "h w 3"], longest: int) -> Float[np.ndarray, "h2 w2 3"]:
    """A linear picture of at most `longest` pixels a side, by area; a smaller one stays as it is."""
    height, width = linear.shape[:2]
    if max(height, width) <= longest:
        return linear
    size = [max(1, round(n * longest / max(height, width))) for n in (width, height)]
    planes = [Image.fromarray(np.ascontiguousarray(linear[..., c])) for c in range(3)]
    resized = [np.asarray(plane.resize((size[0], size[1]), Image.Resampling.BOX)) for plane in planes]
    return np.stack(resized, axis=-1).astype(np.float32)
