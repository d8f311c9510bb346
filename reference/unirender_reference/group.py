"""Renders one group, as a worker of `dataset` does: loads object and lights, and blames the file that fails."""

import dataclasses
import functools
import math
import time

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender_reference import exposure
from unirender_reference.dataset_config import MAX_TILT_DEG, DatasetConfig
from unirender_reference.faults import FileNotSeen, LightFault, ObjectFault, blamed_on
from unirender_reference.lights import Light, LightPool, make_light
from unirender_reference.lights.pool import TRIES
from unirender_reference.members import GroupMembers
from unirender_reference.passes import derive_seed
from unirender_reference.plan import GroupPlan, LightPlan
from unirender_reference.processes import time_limit
from unirender_reference.render import Renderer
from unirender_reference.shapes import MeshObject, make_object
from unirender_reference.shards import RenderedGroup
from unirender_reference.visibility import visibility_members

LOAD_SECONDS = 600.0


def render(config: DatasetConfig, plan: GroupPlan) -> RenderedGroup:
    """Renders and encodes one group; a pure function of its arguments (and of the files that they name).

    Raises:
        FileFailure: the object is a file, and it cannot be loaded or rendered.
        FileNotSeen: this process does not see that file.
        LightFault: a light does not reach the object, and there is no other in its place.
        UnirenderError: anything else went wrong.
    """
    start = time.perf_counter()
    pool = user_lights(config)
    lights = [make_light(light.seed, config.split, pool) for light in plan.lights]
    with blamed_on(plan.mesh, ObjectFault):
        with time_limit(LOAD_SECONDS, "loading it"):
            obj = _load(config, plan)
            renderer = Renderer(_turned(obj, plan) if config.turn_objects else obj, resolution=config.resolution)
        if config.vary == "visibility":
            members, floor, negative_pixels = visibility_members(plan, renderer), None, 0
        else:
            group = GroupMembers(config, plan, renderer)
            exposed = [
                reaching_light(config, own, light, renderer) for own, light in zip(plan.lights, lights, strict=True)
            ]
            lights = [light for light, _ in exposed]
            group.render(lights, [factor for _, factor in exposed])
            members, floor, negative_pixels = group.members, group.floor_count(), group.negative_pixels
    return RenderedGroup(
        key=f"{renderer.obj.name}_g{plan.number}",
        members=members,
        samples=plan.samples,
        nan_pixels=renderer.counters.nan_pixels,
        render_seconds=renderer.counters.render_seconds,
        seconds=time.perf_counter() - start,
        floor=floor,
        negative_pixels=negative_pixels,
        unreadable_lights=tuple(sorted({line for light in lights for line in _skipped(light)})),
    )


@functools.lru_cache(maxsize=1)
def user_lights(config: DatasetConfig) -> LightPool | None:
    """The user's lights; their folder is listed once in a process and configuration (`lights_digest` is part of it).

    Raises:
        UnirenderError: the folder has other files here than where the data set is written.
    """
    pool = config.light_pool()
    if pool is not None and config.lights_digest not in (None, pool.digest):
        raise UnirenderError(
            f"lights {config.lights}: other files, or other sizes, than when the command was started, expected the "
            "same on all machines as long as it runs; run the same command again"
        )
    return pool


def reaching_light(config: DatasetConfig, plan: LightPlan, light: Light, renderer: Renderer) -> tuple[Light, float]:
    """The plan's light, and its exposure on the object.

    A file of the user's that does not reach the object is passed over for another of the same draw, which names it
    (`not_reaching` in its provenance).

    Raises:
        LightFault: there is no other, or `TRIES` of them do not reach it either.
    """
    pool, passed, unread = user_lights(config), list[str](), list[str]()
    while True:
        source = light.provenance["file"] if light.provenance["kind"] == "pool" else None
        said = f"dataset: light {source or light.name}"
        try:
            factor = exposure.scene_exposure(renderer, light.environment, plan.exposure_seed, said)
        except LightFault as error:
            fault = LightFault(f"{error}; complete shards are kept")
            passed.append(source or "")
            unread += _skipped(light)
            left = tuple(name for name in pool.names if name not in passed) if pool and source else ()
            if not left or len(passed) == TRIES:
                raise fault from error
            assert pool is not None
            pool = dataclasses.replace(pool, names=left)
            try:
                light = make_light(plan.seed, config.split, pool)
            except UnirenderError as unreadable:  # all that are left
                raise fault from unreadable
            continue
        if passed:
            said_so = {"not_reaching": "\n".join(passed)}
            if lines := dict.fromkeys([*unread, *_skipped(light)]):
                said_so["skipped"] = "\n".join(lines)
            light = dataclasses.replace(light, provenance={**light.provenance, **said_so})
        return light, factor


def _skipped(light: Light) -> list[str]:
    """The files that a draw of this light passed over, with reasons."""
    return light.provenance.get("skipped", "").splitlines()


def _turned(obj: MeshObject, plan: GroupPlan) -> MeshObject:
    """Seen from a side and a height that the object's seed decides; the name says so, since other parts of a training
    set may have the object from the front."""
    rng = np.random.default_rng(derive_seed("turn", plan.object_seed))
    yaw, tilt = rng.uniform(0, 360), rng.uniform(-MAX_TILT_DEG, MAX_TILT_DEG)
    turned = obj.turned(turn_matrix(yaw, tilt))
    provenance = {**obj.provenance, "turned": f"{yaw:.3f} degrees about +y, then {tilt:.3f} about +x"}
    return dataclasses.replace(turned, name=f"{obj.name}-turned{plan.object_seed}", provenance=provenance)


def turn_matrix(yaw_deg: float, tilt_deg: float) -> Float[np.ndarray, "3 3"]:
    """The rotation about +y, from +z towards +x, then about +x, from +y towards +z."""
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    about_y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    c, s = math.cos(math.radians(tilt_deg)), math.sin(math.radians(tilt_deg))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ about_y


def _load(config: DatasetConfig, plan: GroupPlan) -> MeshObject:
    """The group's object; its own roughness and metallic are left out where the pictures choose them."""
    own_maps = config.materials == "maps"
    if plan.mesh is None:
        return make_object(plan.object_seed, config.split, maps=own_maps)
    from unirender_reference.meshes import load_mesh

    with blamed_on(plan.mesh, UnirenderError, OSError):
        if not plan.mesh.path.is_file():
            raise FileNotSeen(f"mesh {plan.mesh.path}: no such file for the process that was to render it")
        obj = load_mesh(plan.mesh.path, root=plan.mesh.folder)
    provenance = {**obj.provenance, "file": plan.mesh.name}
    obj = dataclasses.replace(obj, name=plan.mesh.key, provenance=provenance)
    if not own_maps:
        return dataclasses.replace(obj, roughness=None, metallic=None)
    if obj.roughness is None or obj.metallic is None:
        raise ObjectFault("has no roughness and metallic of its own, which --materials maps needs; use scalar")
    return obj
