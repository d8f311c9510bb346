"""What each stage of the reconstruction gains: meshes from pictures of objects that are known.

The pictures are what a user would have: 8 bits, masks, posed cameras. Scores are taken from other cameras.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from unirender.errors import UsageError
from unirender.system.machine import memory_excess
from unirender_reference.optimize.shape.config import ShapeConfig

if TYPE_CHECKING:
    from unirender_reference.optimize.shape.measure import ShapeScore
    from unirender_reference.optimize.views import Views
    from unirender_reference.shapes import MeshObject

HELD_OUT = 8
BYTES_A_PIXEL = 32  # of memory: RGBA of the render and of the picture
BRIGHT = 0.9  # linear radiance of the 97th percentile of the object's pixels


@dataclass(frozen=True)
class ShapeMeasure:
    """Score meshes found from posed pictures with masks, stage by stage, against the true objects."""

    objects: tuple[int, ...] = (2, 5, 8, 12)
    """Seeds of objects of the test split, a light each; by default blobs, a carved solid, a gyroid and a knot."""
    views: int = 24
    """Pictures around each object."""
    resolution: int = 64
    """Pixels along each side."""
    spp: int = 64
    """Samples per pixel of the pictures."""
    roughness: float = 0.5
    """Perceptual roughness of the objects."""
    metallic: float = 0.3
    """Metallic of the objects."""
    shape: ShapeConfig = field(default_factory=ShapeConfig)
    """The reconstruction."""

    def run(self) -> int:
        """Measures and prints; returns the exit status."""
        from rich.console import Console
        from rich.table import Table

        if min(self.views, self.resolution, self.spp, len(self.objects)) < 1:
            raise UsageError("expected at least 1 object, view, pixel and sample")
        if excess := memory_excess(BYTES_A_PIXEL * self.views * self.resolution**2):
            raise UsageError(f"--views {self.views}, --resolution {self.resolution}: {excess}; take fewer")
        table = Table("object", "vertices", "stage", "mask IoU", "normal cosine", "chamfer", "seconds", "CPU seconds")
        for seed in self.objects:
            for row in measure(self, seed):
                table.add_row(*row)
            table.add_section()
        console = Console()
        console.print(table)
        console.print(
            f"{self.views} pictures of {self.resolution} px, 8 bits, soft masks; scores from {HELD_OUT} other cameras "
            "(normals: camera buffers, weighted by coverage; chamfer: radii of the bounding sphere). Light and "
            "materials: `solve_appearance` on the mesh of the masks, or the true ones (objects of one colour)."
        )
        return 0


def measure(config: ShapeMeasure, seed: int) -> list[tuple[str, ...]]:
    """Rows of one object: hull, masks, pictures (with the light and materials found; the true ones, if it is plain)."""
    import dataclasses

    import numpy as np

    from unirender.camera import Camera
    from unirender_reference.multiview import orbit
    from unirender_reference.optimize.shape.cameras import Cameras
    from unirender_reference.optimize.shape.measure import score_shape
    from unirender_reference.optimize.shape.reconstruct import reconstruct
    from unirender_reference.optimize.shape.refine_shape import refine_shape
    from unirender_reference.optimize.solution import Solution
    from unirender_reference.optimize.transport.config import TransportConfig
    from unirender_reference.optimize.transport.solve import solve_appearance
    from unirender_reference.shapes import make_object

    true = make_object(seed, "test")
    views, light = pictures(config, true, seed)
    step_deg = 360.0 / config.views
    others = orbit(HELD_OUT, Camera(), start_deg=1.5 * step_deg)
    cameras = Cameras([dataclasses.replace(views.seen[0], pose=pose) for pose in others])
    rows: list[tuple[str, ...]] = []

    def timed(stage: str, work: Callable[[], Any]) -> Any:
        wall, cpu = time.perf_counter(), time.process_time()
        found = work()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        obj = found.obj if isinstance(found, Solution) else found
        rows.append(_row(true, obj, stage, score_shape(obj, true, cameras), wall, cpu))
        return found

    timed("visual hull", lambda: reconstruct(views, dataclasses.replace(config.shape, mask_steps=0)))
    mesh = timed("masks", lambda: reconstruct(views, config.shape))
    solved = solve_appearance(views, mesh, TransportConfig())
    timed("pictures", lambda: refine_shape(views, solved, config.shape))
    if true.albedo.ndim > 1:  # a texture on the true object's charts says nothing about those of the mesh
        return rows
    one, flat = np.broadcast_to(true.albedo, (2, 2, 3)).astype(np.float32), np.ones((2, 2), np.float32)
    known = dataclasses.replace(
        mesh, albedo=one, roughness=np.float32(config.roughness) * flat, metallic=np.float32(config.metallic) * flat
    )
    timed("pictures, true light and material", lambda: refine_shape(views, Solution(known, light), config.shape))
    return rows


def _row(
    true: "MeshObject", obj: "MeshObject", stage: str, score: "ShapeScore", wall: float, cpu: float
) -> tuple[str, ...]:
    figures = (f"{score.mask_iou:.4f}", f"{score.normal_cosine:.4f}", f"{score.chamfer:.4f}")
    return f"{true.name} {true.family}", str(len(obj.vertices)), stage, *figures, f"{wall:.0f}", f"{cpu:.0f}"


def pictures(config: ShapeMeasure, obj: "MeshObject", seed: int) -> "tuple[Views, Any]":
    """8-bit pictures of an object under its light, and the light in display units."""
    import numpy as np

    from unirender.camera import Camera
    from unirender.color import image_srgb
    from unirender_reference.lights import make_light
    from unirender_reference.multiview import orbit
    from unirender_reference.optimize.views import View, Views
    from unirender_reference.render import Renderer

    camera = Camera()
    renderer, light = Renderer(obj, camera, config.resolution), make_light(seed, "test").environment
    poses = orbit(config.views, camera)
    rgba = [found.mean for found in renderer.images(poses, light, config.roughness, config.metallic, config.spp, seed)]
    filled = np.concatenate([image[image[..., 3] > 0.9][:, :3] for image in rgba])
    factor = np.float32(BRIGHT / np.percentile(filled.max(1), 97))
    seen = []
    for index, (image, pose) in enumerate(zip(rgba, poses, strict=True)):
        mask = np.round(np.clip(image[..., 3:], 0, 1) * 255) / 255
        straight = np.where(mask > 0, image[..., :3] * factor / np.maximum(mask, 1 / 255), 0)
        seen.append(View(np.round(image_srgb(straight) * 255) / 255, mask, camera, pose, f"view {index}"))
    return Views(tuple(seen)), (light * factor).astype(np.float32)
