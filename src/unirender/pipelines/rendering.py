"""Rendering intrinsics of any size with a network that knows one size."""

from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence

import numpy as np
from jaxtyping import Float

from unirender.blocks import by_rows
from unirender.color import image_srgb as encode_srgb
from unirender.color import srgb_decode
from unirender.intrinsics import Intrinsics
from unirender.models.priors import PRIORS, Prior
from unirender.pipelines.dim_light import brightened, darkened, gain_of_dim
from unirender.pipelines.framing import Frame
from unirender.pipelines.masked_maps import divide
from unirender.pipelines.network import Network, Overflow
from unirender.pipelines.rendered_maps import ready_to_render, to_derive, told_derived
from unirender.pipelines.settings import Sampling


def enter(network: Network, intrinsics: Intrinsics) -> tuple[Frame, Intrinsics]:
    """The intrinsics at the network's size, and how they got there."""
    frame = Frame.around(intrinsics.require("mask")["mask"], network.size)
    return frame, frame.enter_intrinsics(intrinsics, network.conditioning.packing.environment_size)


def render_any_size(
    network: Network,
    scenes: Sequence[Intrinsics],
    how: Sampling,
    watch: Callable[[dict[str, Overflow]], None] = lambda overflow: None,
    derived: Collection[str] = (),
    shadows: bool = True,
) -> Iterator[Float[np.ndarray, "h w 3"]]:
    """The premultiplied linear images in [0, 1] at the sizes of the intrinsics, one after another.

    The network sees all at once, but of each scene only its small size is kept when its image is there.

    Args:
        network: that renders.
        scenes: normal, roughness and metallic are needed; see `UniRenderPipeline.render`.
        how: steps, samples and noise.
        watch: is told which HDR maps exceed the network's range.
        derived: which of specular and diffuse were derived from the light, without shadows.
        shadows: whether what is derived here, since the intrinsics lack it, has the shadows that the picture's own
            surfaces cast, and what they reflect.
    """
    without_shadows = [told_derived(to_derive(scene), shadows).union(derived) for scene in scenes]
    ready = deque(ready_to_render(scene, shadows) for scene in scenes)
    del scenes
    entered = [enter(network, scene) for scene in ready]
    for _, small in entered:
        watch(network.overflow(small))
    gains = [gain_of_dim(small) for _, small in entered]
    bright = [brightened(small, gain) for (_, small), gain in zip(entered, gains, strict=True)]
    rendered = network.images(bright, how, without_shadows)
    for (frame, _), small, gain, image in zip(entered, bright, gains, rendered, strict=True):
        scene = brightened(ready.popleft(), gain)
        left = _leave(network, scene, frame, small, image)
        if gain != 1:
            closed_form = _prior(network).image(scene) if _has_closed_form(scene) else None
            left = darkened(left, closed_form, scene.require("mask")["mask"], gain)
        yield left


def _leave(
    network: Network, intrinsics: Intrinsics, frame: Frame, small: Intrinsics, rendered: Float[np.ndarray, "s s 3"]
) -> Float[np.ndarray, "h w 3"]:
    """What the network rendered of the `small` intrinsics, at the size of the intrinsics."""
    mask = intrinsics.require("mask")["mask"]
    if frame.identity:
        return rendered * (mask > 0)
    inside = small.require("mask")["mask"]
    if not _has_closed_form(intrinsics):
        return np.clip(frame.leave_map(divide(rendered, inside), mask), 0, 1) * mask
    # The detail of a larger picture is in its closed form; the model adds what it lacks, in display values.
    closed_form = _prior(network)
    pictures = {"rendered": divide(rendered, inside), "closed form": divide(closed_form.image(small), inside)}
    radiance, small_image = frame.leave_maps(pictures, mask).values()
    return by_rows(_with_change, closed_form.image(intrinsics), mask, small_image, radiance)


def _prior(network: Network) -> Prior:
    return network.conditioning.physics_prior or PRIORS["split_sum"]


def _has_closed_form(intrinsics: Intrinsics) -> bool:
    return {"albedo", "specular", "diffuse"} <= set(intrinsics.present)


def _with_change(
    large: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w 1"],
    before: Float[np.ndarray, "h w 3"],
    after: Float[np.ndarray, "h w 3"],
) -> Float[np.ndarray, "h w 3"]:
    """A premultiplied image with what `after` has beyond `before`, in display values; these two are straight."""
    change = encode_srgb(after) - encode_srgb(before)
    return srgb_decode(np.clip(encode_srgb(divide(large, mask)) + change, 0, 1)) * mask
