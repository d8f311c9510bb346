"""Rendering intrinsics of any size with a network that knows one size."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from unirender.color import image_srgb as encode_srgb
from unirender.color import srgb_decode
from unirender.intrinsics import Intrinsics
from unirender.models.priors import PRIORS
from unirender.pipelines.framing import Frame, divide
from unirender.pipelines.inputs import ready_to_render
from unirender.pipelines.network import Network, Overflow
from unirender.pipelines.settings import Sampling


def enter(network: Network, intrinsics: Intrinsics) -> tuple[Frame, Intrinsics]:
    """The intrinsics at the network's size, and how they got there."""
    frame = Frame(intrinsics.height, intrinsics.width, network.size)
    return frame, frame.enter_intrinsics(intrinsics, network.conditioning.packing.environment_size)


def render_any_size(
    network: Network,
    intrinsics: Intrinsics,
    how: Sampling,
    watch: Callable[[dict[str, Overflow]], None] = lambda overflow: None,
) -> Float[np.ndarray, "h w 3"]:
    """The premultiplied linear image in [0, 1] at the intrinsics' size.

    Args:
        network: that renders.
        intrinsics: normal, roughness and metallic are needed; see `UniRenderPipeline.render`.
        how: steps, samples and noise.
        watch: is told which HDR maps exceed the network's range.
    """
    intrinsics = ready_to_render(intrinsics)
    frame, small = enter(network, intrinsics)
    watch(network.overflow(small))
    rendered = network.image(small, how)
    mask = intrinsics.require("mask")["mask"]
    if frame.identity:
        return rendered * (mask > 0)
    inside = small.require("mask")["mask"]
    radiance = frame.leave_map(divide(rendered, inside), mask)
    if not {"albedo", "specular", "diffuse"} <= set(intrinsics.present):
        return radiance * mask
    # The detail of a larger picture is in its closed form; the model adds what it lacks, in display values.
    closed_form = network.conditioning.physics_prior or PRIORS["split_sum"]
    small_image = frame.leave_map(divide(closed_form.image(small), inside), mask)
    change = encode_srgb(radiance) - encode_srgb(small_image)
    large_image = divide(closed_form.image(intrinsics), mask)
    return srgb_decode(np.clip(encode_srgb(large_image) + change, 0, 1)) * mask
