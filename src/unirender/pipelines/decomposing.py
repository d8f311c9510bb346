"""Decomposing pictures of any size with a network that knows one size: all of them in one batch.

The steps in their order, each with the module that knows how:

    each picture is brought to the network's square                         `framing`
    p(attributes | image), the inverse case of the paper's Eq. 3            `network`, `diffusion.inference`
    maps at the picture's size; materials read by the checkpoint's line     `results`, `calibration`
    the detail of tiles, if it is asked for                                 `tiling`
    closed: what is rendered of the maps is the picture                     `closure`
    the albedo made even between its edges, if it is asked for              `flat_albedo`
    samples become mean and spread, and the light agrees with s and d       `results`
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender.pipelines.calibration import Lines, calibrated
from unirender.pipelines.closure import close_decomposition
from unirender.pipelines.flat_albedo import with_flat_albedo
from unirender.pipelines.framing import Frame
from unirender.pipelines.network import Network
from unirender.pipelines.rendering import render_any_size
from unirender.pipelines.results import Decomposition, combine, predicted_intrinsics, with_agreeing_light
from unirender.pipelines.settings import Sampling, same_noise
from unirender.pipelines.tiling import add_detail, blend_tiles


@dataclass(frozen=True)
class View:
    """A picture that was checked.

    Attributes:
        image_linear: premultiplied, linear.
        mask: coverage.
        camera: that took it.
    """

    image_linear: Float[np.ndarray, "h w 3"]
    mask: Float[np.ndarray, "h w 1"]
    camera: Camera

    def frame(self, size: int) -> Frame:
        """How it sits in a network's square."""
        return Frame.around(self.mask, size)


def decompose_views(
    network: Network,
    views: Sequence[View],
    how: Sampling,
    *,
    material: str,
    closed: bool,
    flat: bool,
    tile: bool,
    calibration: Lines | None = None,
) -> list[Decomposition]:
    """Inverse rendering.

    Args:
        network: whose size the pictures are brought to.
        views: any sizes and cameras.
        how: steps, samples and noise.
        material: `scalar` or `map`.
        closed: whether albedo, s and d are changed so that their rendering is the picture, one more batch, and then the
            light so that it agrees with s and d.
        flat: whether the albedo is made even between its edges, which s and d make up for.
        tile: whether pictures larger than the network's square get the detail of tiles; a batch for every few tiles.
        calibration: lines by which roughness and metallic are read.
    """
    frames = [view.frame(network.size) for view in views]
    found = network.attributes(
        [frame.enter(view.image_linear) for view, frame in zip(views, frames, strict=True)],
        [frame.enter(view.mask) for view, frame in zip(views, frames, strict=True)],
        [frame.camera(view.camera) for view, frame in zip(views, frames, strict=True)],
        how,
    )
    samples = [
        calibrated([predicted_intrinsics(maps, frame, view.mask, view.camera, material) for maps in own], calibration)
        for view, frame, own in zip(views, frames, found, strict=True)
    ]
    for i, (view, frame) in enumerate(zip(views, frames, strict=True)):
        if tile and frame.shown > network.size:
            samples[i] = _with_detail(network, view, frame, samples[i], how, _one(how, i).draw_seed())
    if closed:
        rendered = render_any_size(network, [sample for own in samples for sample in own], Sampling.of())
        for view, own in zip(views, samples, strict=True):
            for i in range(len(own)):  # one after another, so that what each was before is let go
                own[i] = close_decomposition(own[i], view.image_linear, next(rendered))
    if flat:
        for view, frame, own in zip(views, frames, samples, strict=True):
            for i in range(len(own)):
                own[i] = with_flat_albedo(own[i], view.image_linear, frame)
    combined = [combine(tuple(own)) for own in samples]
    return [with_agreeing_light(found) for found in combined] if closed else combined


def _one(how: Sampling, picture: int) -> Sampling:
    """The settings of one picture of a batch."""
    return replace(how, generator=how.generator[picture]) if isinstance(how.generator, Sequence) else how


def _with_detail(
    network: Network, view: View, frame: Frame, samples: list[Intrinsics], how: Sampling, seed: int
) -> list[Intrinsics]:
    """The samples of a picture with the detail of its tiles, which are let go of."""
    blended = _tiled(network, view, how, seed)
    return [add_detail(whole, fine, frame) for whole, fine in zip(samples, blended, strict=True)]


def _tiled(network: Network, view: View, how: Sampling, seed: int) -> list[dict[str, np.ndarray]]:
    """The picture's maps from tiles of the network's size, one look at each; all see the same noise, so that none
    differs."""

    def predict(images: Sequence[np.ndarray], masks: Sequence[np.ndarray], cameras: Sequence[Camera]) -> list:
        noise = same_noise(seed, len(images))
        return network.attributes(images, masks, cameras, replace(how, generator=noise, looks=1))

    return blend_tiles(view.image_linear, view.mask, view.camera, network.size, predict)
