"""What the optimiser sees: pictures of one object from known cameras, under one light."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from unirender.camera import Camera
from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender.intrinsics import as_numbers
from unirender.pictures import DISPLAY_WHITE
from unirender.shown import short_repr
from unirender_reference.sensors import check_pose

RANGE_TOLERANCE = 1e-3
BLACK = 0.5 / 255  # display values of 8 bits below are 0


@dataclass(frozen=True)
class View:
    """One picture of the object.

    Attributes:
        image: (h, w, 3) straight colour, as in a PNG with alpha (not premultiplied; whatever it is where the mask is
            0): display values in [0, 1], or linear radiance of any scale if the views are `hdr`.
        mask: (h, w, 1) coverage, [0, 1].
        camera: vertical field of view and principal point.
        pose: (4, 4) camera to world: columns are the camera's right, up, towards the viewer, and its position. Stays
            float64 if it is given so: a place far from the world's origin needs the digits.
        name: for messages and files.
        clipped: (h, w, 3) where a display value is only a lower bound; None: where it is 1. (Of a picture that was
            reduced: where any of the values was that a pixel is the mean of.)
    """

    image: Float[np.ndarray, "h w 3"]
    mask: Float[np.ndarray, "h w 1"]
    camera: Camera
    pose: Float[np.ndarray, "4 4"]
    name: str = "view"
    clipped: Bool[np.ndarray, "h w 3"] | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if not isinstance(self.camera, Camera):
            raise UnirenderError(f"{self.name}: got camera {self.camera!r:.40}, expected a unirender.camera.Camera")
        for label in ("image", "mask", "pose"):
            numbers = as_numbers(f"{self.name}: {label}", getattr(self, label))
            if label == "pose" and np.asarray(self.pose).dtype == np.float64:
                numbers = np.asarray(self.pose)
            object.__setattr__(self, label, numbers)
        if self.image.ndim != 3 or self.image.shape[2] != 3 or self.mask.shape != (*self.image.shape[:2], 1):
            raise UnirenderError(
                f"{self.name}: got image {self.image.shape}, mask {self.mask.shape}; expected (h, w, 3) and (h, w, 1)"
            )
        if self.clipped is not None and self.clipped.shape != self.image.shape:
            raise UnirenderError(
                f"{self.name}: got clipped {self.clipped.shape}, expected {self.image.shape}; None: no value is"
            )
        if not np.isfinite(self.image).all() or self.image.min() < 0:
            raise UnirenderError(f"{self.name}: the image has negative, infinite or NaN values; expected values >= 0")
        if not (self.mask.min() >= 0 and self.mask.max() <= 1):
            raise UnirenderError(f"{self.name}: the mask leaves [0, 1]; expected coverage")
        check_pose(self.pose, self.name)


@dataclass(frozen=True)
class Views:
    """Pictures of one object under one light.

    Attributes:
        seen: what is optimised against.
        held_out: what the fit is watched by (early stop), never optimised against; may be empty.
        hdr: images are linear radiance, of one scale; else display values, clipped at 1.
    """

    seen: tuple[View, ...]
    held_out: tuple[View, ...] = ()
    hdr: bool = False

    def __post_init__(self) -> None:
        if not self.seen:
            raise UnirenderError("views: got none, expected at least one picture with its camera")
        for view in (*self.seen, *self.held_out):
            if not isinstance(view, View):
                raise UnirenderError(f"views: got a {type(view).__name__} among them, expected a View each")
        sizes = {view.image.shape: view.name for view in (*self.seen, *self.held_out)}
        if len(sizes) > 1:
            named = ", ".join(f"{width} x {height} ({name})" for (height, width, _), name in sorted(sizes.items()))
            raise UnirenderError(f"views: got pictures of sizes {named}, expected one size; resample them")
        for view in (*self.seen, *self.held_out):
            if not self.hdr and view.image.max() > 1 + RANGE_TOLERANCE:
                raise UnirenderError(
                    f"{view.name}: display values reach {view.image.max():.3g}, expected [0, 1]; linear pictures are "
                    "`hdr` views"
                )
        if not any(view.mask.any() for view in self.seen):
            raise UnirenderError("views: the masks are empty in all pictures; expected the object's coverage")

    @property
    def height(self) -> int:
        return self.seen[0].image.shape[0]

    @property
    def width(self) -> int:
        return self.seen[0].image.shape[1]

    def saturated(self, view: View) -> Bool[np.ndarray, "h w 3"]:
        """Where the radiance may be more than the picture shows."""
        if self.hdr:
            return np.zeros(view.image.shape, bool)
        return view.image >= DISPLAY_WHITE if view.clipped is None else view.clipped

    def black(self, view: View) -> bool:
        """Whether a picture shows no light wherever its mask covers it."""
        covered = view.image[view.mask[..., 0] > 0]
        return float(covered.max(initial=0)) <= (0 if self.hdr else BLACK)

    def require_light(self) -> None:
        """Looks whether there is anything to see.

        Raises:
            UnirenderError: all pictures are black wherever their masks cover them.
        """
        if all(map(self.black, self.seen)):
            raise UnirenderError(
                f"views: all {len(self.seen)} pictures are black wherever their masks cover them, expected an object "
                "under light; do the masks belong to the pictures?"
            )

    def linear(self, view: View) -> Float[np.ndarray, "h w 3"]:
        """The picture as premultiplied linear radiance; display values of 1 may stand for more."""
        straight = view.image if self.hdr else srgb_decode(np.clip(view.image, 0, 1))
        return (straight * view.mask).astype(np.float32)


@dataclass(frozen=True)
class Step:
    """One line of the record of an optimisation (`history.jsonl`).

    Attributes:
        stage: "transport", "refine", "shape", ...
        iteration: within the stage.
        seconds: since the optimisation began.
        values: losses and figures by name.
    """

    stage: str
    iteration: int
    seconds: float
    values: dict[str, float]
