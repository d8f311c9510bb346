"""What is put together from parts, against the whole rendered at once: effects, lobes, sweep."""

from unirender_reference.checks.invariants import MATERIAL, SIZE, SPP, concave, random_light
from unirender_reference.checks.outcome import BATCHES, Check, against_estimate
from unirender_reference.effects import render_effects
from unirender_reference.lobes import compose, render_lobes
from unirender_reference.passes import Estimate, derive_seed
from unirender_reference.render import DIRECT_DEPTH, Renderer
from unirender_reference.sweep import render_sweep

ROUGHNESS = 0.3
BETWEEN = 0.1  # a metallic value that no node has
TWO_BOUNCES = DIRECT_DEPTH + 1


def effects_sum(seed: int) -> Check:
    """Unshadowed light, shadow and interreflection add up to the path-traced image."""
    renderer, light = Renderer(concave(), resolution=SIZE), random_light(seed)
    parts = render_effects(renderer, light, *MATERIAL, SPP, derive_seed(seed, "effects-sum", 0), batches=BATCHES)
    whole = renderer.image(light, *MATERIAL, 4 * SPP, derive_seed(seed, "effects-sum", 1), batches=BATCHES)
    return _against_whole("effects-sum", parts.total(), whole, "unshadowed + shadow + interreflection = image")


def lobes_composition(seed: int) -> Check:
    """The buffers of the four lobes, composed, are the image of direct light."""
    renderer, light = Renderer(concave(), resolution=SIZE), random_light(seed)
    lobes = render_lobes(renderer, light, *MATERIAL, SPP, derive_seed(seed, "lobes-composition", 0), BATCHES)
    own = derive_seed(seed, "lobes-composition", 1)
    whole = renderer.image(light, *MATERIAL, 4 * SPP, own, DIRECT_DEPTH, BATCHES)
    return _against_whole("lobes-composition", compose(lobes), whole, "sum of weight x buffer = direct image")


def sweep(seed: int) -> Check:
    """A metallic value between the nodes of a sweep is the image rendered at that value: exact for two bounces."""
    renderer, light = Renderer(concave(), resolution=SIZE), random_light(seed)
    first, second = (derive_seed(seed, "sweep", index) for index in range(2))
    rendered = render_sweep(renderer, light, [ROUGHNESS], [BETWEEN], 4 * SPP, first, BATCHES, depth=TWO_BOUNCES)
    whole = renderer.image(light, ROUGHNESS, BETWEEN, 4 * SPP, second, TWO_BOUNCES, BATCHES)
    note = f"metallic {BETWEEN:g} from {len(rendered.node_values)} nodes, roughness {ROUGHNESS:g}"
    return _against_whole("sweep", rendered.estimate(0, 0), whole, note)


def _against_whole(name: str, parts: Estimate, whole: Estimate, note: str) -> Check:
    """The z-test of both, RGB, where the object covers more than half a pixel."""
    assert parts.variance is not None
    assert whole.variance is not None
    a, b = ((e.mean[..., :3], v[..., :3]) for e, v in ((parts, parts.variance), (whole, whole.variance)))
    return against_estimate(name, *a, *b, whole.mean[..., 3] > 0.5, note)
