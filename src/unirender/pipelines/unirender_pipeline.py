"""`UniRenderPipeline`: decompose, render, edit and relight with one dual-stream model.

    decompose   picture -> p(attributes | image), Eq. 3's inverse case -> maps closed, light made to agree with s and d
    render      maps, s and d derived where unknown -> p(image | attributes), Eq. 3's rendering case -> picture
    edit        decompose -> new material, s of its roughness -> render before and after -> the change on the input
    relight     decompose -> s and d of the new light -> render before and after -> the change on the input

Eq. 3 is the paper's: the stream that is given is clean, the other begins as noise (`unirender.diffusion.inference`). In
this order the steps stand in `unirender.pipelines.decomposing` and `unirender.pipelines.rendering`.

Its public arrays are numpy. A *picture* is straight display values like a PNG's, with its mask beside it; a *linear
image* that comes back is premultiplied. Any size: pictures are brought to the model's square and results back
(`unirender.pipelines.framing`); `size` runs the network at another multiple of `size_multiple`, `tile` adds the detail
of tiles (`unirender.pipelines.tiling`). The sampler is the `scheduler` component, or named in a call.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from typing import Any, overload

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from unirender.arguments import check_switches
from unirender.camera import Camera
from unirender.color import srgb_decode
from unirender.diffusion.sampling import Generators
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.picture_files.mask_rim import MIXED, mixture_explains
from unirender.pipelines.carried_light import with_carried_light
from unirender.pipelines.decomposing import View, decompose_views
from unirender.pipelines.dual_stream_pipeline import DualStreamPipeline
from unirender.pipelines.editing import anchor, check_exposure, specular_for_roughness, too_coarse, under_light
from unirender.pipelines.framing import thumbnail
from unirender.pipelines.inputs import as_environment, as_list, as_material, as_picture, check_decomposition
from unirender.pipelines.network import Overflow
from unirender.pipelines.rendered_maps import check_rendered, ready_to_render, report_facing_away, told_derived
from unirender.pipelines.rendering import enter, render_any_size
from unirender.pipelines.results import Decomposition, EditResult
from unirender.pipelines.settings import (
    Sampling,
    check_material,
    check_settings,
    list_cameras,
    same_noise,
    step_end_of,
)

# Shapes and ranges are checked in `unirender.pipelines.inputs`.
PictureLike = np.ndarray | Image.Image
ScalarOrMap = np.ndarray | np.floating | float
Callback = Callable[[Any, int, int, dict[str, Any]], Mapping[str, Any] | None]


class UniRenderPipeline(DualStreamPipeline):
    """One dual-stream model in both directions. Get it by `from_pretrained`, with a folder or the name of a shipped
    checkpoint (`tiny`, `small`); the arguments of the class itself are those of `DualStreamPipeline`.
    """

    @overload
    def __call__(self, image: list | tuple, mask: Any = None, **kwargs: Any) -> list[Decomposition]: ...

    @overload
    def __call__(self, image: PictureLike, mask: Any = None, **kwargs: Any) -> Decomposition: ...

    def __call__(self, image: Any, mask: Any = None, **kwargs: Any) -> Decomposition | list[Decomposition]:
        """The same as `decompose`; of a list of pictures, the same as `decompose_batch`."""
        if isinstance(image, list | tuple):
            return self.decompose_batch(image, mask, **kwargs)
        return self.decompose(image, mask, **kwargs)

    def decompose(
        self,
        image_srgb: PictureLike,
        mask: PictureLike | None = None,
        *,
        camera: Camera | None = None,
        mode: str = "mean",
        num_inference_steps: int | None = None,
        num_samples: int | None = None,
        generator: torch.Generator | None = None,
        sampler: str | None = None,
        size: int | None = None,
        callback_on_step_end: Callback | None = None,
        looks: int = 1,
        tile: bool = False,
        material: str | None = None,
        closed: bool = True,
        flat: bool = False,
    ) -> Decomposition:
        """Takes a picture apart into maps and light (inverse rendering).

        Args:
            image_srgb: display values [h w 3] in [0, 1], not premultiplied, or a PIL picture (an EXIF orientation is
                not applied, and logged).
            mask: coverage [h w 1] in [0, 1]; None: a PIL picture's alpha, else the whole frame, which is logged once.
            camera: the contract's default if None.
            mode: `mean` (one step, the expectation) or `sample` (diffusion samples: their mean and spread).
            num_inference_steps: of `sample`; 20 if None.
            num_samples: of `sample`; 5 if None.
            generator: a CPU generator for the noise; None: a fixed noise in mode `mean` (whose one step hardly depends
                on it: roughness and metallic by some 0.01), torch's global state in mode `sample`.
            sampler: of `sample`: `ddim` or `unipc`; None: the pipeline's scheduler.
            size: side of the square at which the network runs, a multiple of `size_multiple`; None: the model's own.
            callback_on_step_end: as in diffusers: is called after each step as (pipeline, step, timestep, {"latents":
                tensor [b c h w]}), b the samples or looks of each picture in a row, and returns that dictionary, whose
                latents count from then on (None: as they were). Also of each batch of tiles; not of closing. What it
                raises ends the call.
            looks: at the picture, of mode `mean`, 1 to 12: mirrored, and with its colour channels exchanged. Their mean
                is better and takes longer (`unirender.pipelines.looks`); 6 give most of it.
            tile: add the detail of tiles to albedo and normal where the picture is larger than that square.
            material: one number per object or maps; None: as the checkpoint was trained.
            closed: change albedo, s and d so that their rendering is the picture (`unirender.pipelines.closure`), and
                the light so that it agrees with s and d (`unirender.pipelines.revealed_light`); False gives what the
                network predicts (materials by the checkpoint's calibration, if it has one).
            flat: make the albedo even between its edges, and move the detail that it loses into s and d
                (`unirender.pipelines.flat_albedo`).

        Returns:
            The maps at the picture's size, the light, and roughness and metallic of the object as numbers.

        Raises:
            UnirenderError: the picture, the mask or a setting is not usable; the message says why.
        """
        (result,) = self.decompose_batch(
            [image_srgb],
            [mask],
            cameras=camera,
            mode=mode,
            num_inference_steps=num_inference_steps,
            num_samples=num_samples,
            generator=generator,
            sampler=sampler,
            size=size,
            callback_on_step_end=callback_on_step_end,
            looks=looks,
            tile=tile,
            material=material,
            closed=closed,
            flat=flat,
        )
        return result

    def decompose_batch(
        self,
        images_srgb: Iterable[PictureLike],
        masks: Iterable[PictureLike | None] | None = None,
        *,
        cameras: Camera | Iterable[Camera] | None = None,
        mode: str = "mean",
        num_inference_steps: int | None = None,
        num_samples: int | None = None,
        generator: Generators = None,
        sampler: str | None = None,
        size: int | None = None,
        callback_on_step_end: Callback | None = None,
        looks: int = 1,
        tile: bool = False,
        material: str | None = None,
        closed: bool = True,
        flat: bool = False,
    ) -> list[Decomposition]:
        """Takes several pictures of any sizes apart, in one batch of the network (and one more to close them).

        Args:
            images_srgb: as for `decompose`.
            masks: one for each picture, as for `decompose`.
            cameras: one for all, or one for each.
            mode: as for `decompose`, like the other settings.
            num_inference_steps: of `sample`.
            num_samples: of `sample`.
            generator: one for each picture (whose noise is then what it would be alone), or one from which all draw in
                turn; None: as for `decompose`.
            sampler: of `sample`.
            size: side of the network's square.
            callback_on_step_end: of all pictures at once.
            looks: at each picture.
            tile: add the detail of tiles.
            material: one number per object or maps.
            closed: change albedo, s, d and the light, as for `decompose`.
            flat: make the albedo even, likewise.

        Returns:
            One decomposition for each picture, in their order.

        Raises:
            UnirenderError: as `decompose`; no pictures, or another number of masks, cameras or generators.
        """
        check_switches(tile=tile, closed=closed, flat=flat)
        images_srgb = as_list("images_srgb", images_srgb, channels=3)
        masks = [None] * len(images_srgb) if masks is None else as_list("masks", masks, channels=1)
        cameras = list_cameras(cameras, len(images_srgb))
        if not images_srgb or {len(images_srgb)} != {len(masks), len(cameras)}:
            raise UnirenderError(
                f"decompose: got {len(images_srgb)} pictures, {len(masks)} masks and {len(cameras)} cameras, expected "
                "at least one picture, and one of each for every picture"
            )
        material = check_material(self.config["material"] if material is None else material)
        step_end = step_end_of(self, callback_on_step_end)
        how = Sampling.of(mode, num_inference_steps, num_samples, generator, looks, step_end)
        network = self._network(mode, sampler, size)
        views, thumbnails = [], []
        for image, mask, camera in zip(images_srgb, masks, cameras, strict=True):
            picture, cover = self._picture(image, mask)
            views.append(View(srgb_decode(picture) * cover, cover, camera))
            thumbnails.append(thumbnail(picture, cover))
        lines = self.config["calibration"]
        found = decompose_views(
            network, views, how, material=material, closed=closed, flat=flat, tile=tile, calibration=lines
        )
        self.maybe_free_model_hooks()
        made_with = {"looks": how.looks, "tile": bool(tile), "material": material}
        made_with |= {"closed": bool(closed), "flat": bool(flat)}
        return [
            replace(each, thumbnail=small, made_with=made_with) for each, small in zip(found, thumbnails, strict=True)
        ]

    def render(
        self,
        intrinsics: Intrinsics,
        *,
        mode: str = "mean",
        num_inference_steps: int | None = None,
        num_samples: int | None = None,
        generator: torch.Generator | None = None,
        sampler: str | None = None,
        size: int | None = None,
        callback_on_step_end: Callback | None = None,
        derived: str | Collection[str] = (),
        shadows: bool = True,
    ) -> Float[np.ndarray, "h w 3"]:
        """Renders maps to a picture; several samples are averaged in linear light.

        Args:
            intrinsics: normal, roughness and metallic are needed; albedo, specular, diffuse and environment may be
                missing. A missing mask is where the normal is not 0 (the whole frame where it is 0 nowhere); missing s
                and d are derived from the environment where it is given. Those that are there count, whatever it is:
                under another light `intrinsics.replace(environment=light, specular=None, diffuse=None)` is rendered.
                Light far dimmer than in the training data is rendered brighter, and the picture made dark again
                (`unirender.pipelines.dim_light`).
            mode: as for `decompose`, like the other settings.
            num_inference_steps: of `sample`.
            num_samples: of `sample`.
            generator: of the noise.
            sampler: of `sample`.
            size: side of the network's square.
            callback_on_step_end: of the noise's steps.
            derived: which of the intrinsics' specular and diffuse lack shadows, since they were derived from a light:
                by `unirender.pipelines.editing.under_light` both, or with its `shadows` d alone.
            shadows: whether s and d that are derived here have the shadows that the surfaces of the picture cast on one
                another (`unirender.pipelines.self_shadow`), and what these reflect where they hide the light
                (`unirender.pipelines.bounced_light`); False: neither, which the network is told.

        Returns:
            Premultiplied linear image at the intrinsics' size, in [0, 1].

        Raises:
            UnirenderError: a map that is needed is missing, or a setting is not usable.
        """
        derived = (derived,) if isinstance(derived, str) else derived
        check_rendered(intrinsics, derived)
        check_switches(shadows=shadows)
        step_end = step_end_of(self, callback_on_step_end)
        how = Sampling.of(mode, num_inference_steps, num_samples, generator, step_end=step_end)
        network = self._network(mode, sampler, size)
        (image,) = render_any_size(network, [intrinsics], how, self._report_overflow, derived, shadows)
        report_facing_away(intrinsics)
        self.maybe_free_model_hooks()
        return image

    def overflow(self, intrinsics: Intrinsics) -> dict[str, Overflow]:
        """Which of s, d and environment exceed, at the model's size, the brightest that the network was taught.

        Such values are not clipped: they enter above the range of the training data. `render` logs them, once a map.

        Args:
            intrinsics: as for `render`.

        Returns:
            By name of the map; {} where nothing does.

        Raises:
            UnirenderError: as `render`.
        """
        check_rendered(intrinsics, ())
        network = self._network()
        return network.overflow(enter(network, ready_to_render(intrinsics))[1])

    def edit(
        self,
        image_srgb: PictureLike,
        mask: PictureLike | None = None,
        *,
        roughness: ScalarOrMap | None = None,
        metallic: ScalarOrMap | None = None,
        anchored: bool = True,
        decomposition: Decomposition | None = None,
        **sampling: Any,
    ) -> EditResult:
        """Changes the material of a picture's object: decomposes, derives s for the new roughness, renders.

        Args:
            image_srgb: as for `decompose`.
            mask: as for `decompose`.
            roughness: new value or map [h w 1] or [h w], in [0, 1]; None: unchanged.
            metallic: the same.
            anchored: the change is applied to the input (`unirender.pipelines.editing.anchor`); else the plain render.
            decomposition: of this picture with this mask, if it is at hand: taken as it is, so that camera, looks,
                tile, material, closed and flat are its own; others are refused.
            **sampling: camera, mode, num_inference_steps, num_samples, generator, sampler, size, callback_on_step_end
                (of all passes, one after another), looks, tile, material, closed and flat, as for `decompose`.

        Returns:
            The edited picture (premultiplied and linear), its maps, and the decomposition.

        Raises:
            UnirenderError: as `decompose`; or nothing to change; a value outside [0, 1]; or a decomposition that does
                not fit.
        """
        check_settings(sampling, anchored=anchored)
        if roughness is None and metallic is None:
            raise UnirenderError("edit: nothing to change, expected roughness or metallic (or both)")
        picture, cover = self._picture(image_srgb, mask)
        decomposition = self._decomposition(picture, cover, decomposition, sampling)
        before = decomposition.with_network_light
        edited, bounded, coarse = before, 0.0, None
        if metallic is not None:
            edited = edited.replace(metallic=as_material("metallic", metallic, cover))
        if roughness is not None:
            target = as_material("roughness", roughness, cover)
            specular, bounded = specular_for_roughness(before, target)
            coarse = too_coarse(before, target)
            edited = edited.replace(roughness=target, specular=specular)
        image = self._rerender(picture, cover, before, edited, anchored, sampling)
        edited = edited.replace(environment=decomposition.intrinsics.environment)
        return EditResult(image, edited, decomposition, bounded, coarse)

    def relight(
        self,
        image_srgb: PictureLike,
        environment: np.ndarray | None,
        mask: PictureLike | None = None,
        *,
        exposure: str = "auto",
        anchored: bool = True,
        specular: Float[np.ndarray, "h w 3"] | None = None,
        diffuse: Float[np.ndarray, "h w 3"] | None = None,
        shadows: bool = False,
        decomposition: Decomposition | None = None,
        **sampling: Any,
    ) -> EditResult:
        """Puts a picture's object under another light: decomposes, derives s and d, renders.

        s and d are derived from the predicted normal and roughness at the light's own resolution, unless they are
        given, and what the decomposition's s and d have beyond its own light is carried over
        (`unirender.pipelines.carried_light`).

        Args:
            image_srgb: as for `decompose`.
            environment: lat-long radiance [eh ew 3] in camera axes, twice as wide as high; None where both s and
                d are given.
            mask: as for `decompose`.
            exposure: `auto` scales the light so that white under it is as bright as in the training data; `keep` not.
            anchored: as for `edit`.
            specular: s under the new light, if known.
            diffuse: d under the new light, if known.
            shadows: as for `render`; off, since predicted normals say less of where they fall.
            decomposition: as for `edit`.
            **sampling: as for `edit`.

        Returns:
            The relit picture (premultiplied and linear), its maps, and the decomposition.

        Raises:
            UnirenderError: as `decompose`; or neither a light nor both s and d are given; or a decomposition that does
                not fit.
        """
        check_settings(sampling, anchored=anchored, shadows=shadows)
        if environment is None and (specular is None or diffuse is None):
            raise UnirenderError("relight: no light, expected an environment, or both specular and diffuse")
        check_exposure(exposure)
        picture, cover = self._picture(image_srgb, mask)
        if environment is not None:
            environment = as_environment(environment)
        decomposition = self._decomposition(picture, cover, decomposition, sampling)
        before = decomposition.with_network_light
        if environment is not None:
            edited = under_light(before, environment, exposure, specular, diffuse, mirrors=False, shadows=shadows)
        else:
            edited = before.replace(environment=None, specular=specular, diffuse=diffuse)
        missing = [name for name, given in (("specular", specular), ("diffuse", diffuse)) if given is None]
        edited = with_carried_light(before, edited, missing, decomposition.own_agreeing_light, shadows=shadows)
        derived = told_derived(missing, shadows)
        image = self._rerender(picture, cover, before, edited, anchored, sampling, derived)
        return EditResult(image, edited, decomposition)

    def _picture(self, image: Any, mask: Any) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w 1"]]:
        picture, cover = as_picture(image, mask)
        if mask is None and cover.min() == 1:
            self._report_once("mask", "not given, and no pixel is transparent: the whole frame is taken as the object")
        if mask is not None and mixture_explains(picture, cover) > MIXED:
            self._report_once(
                "image",
                "a background is mixed into the rim of the mask, expected straight colours as beside an alpha channel; "
                "unirender.picture_files.mask_rim.without_background(image_srgb, mask) takes it away",
            )
        return picture, cover

    def _decomposition(
        self,
        picture: Float[np.ndarray, "h w 3"],
        cover: Float[np.ndarray, "h w 1"],
        at_hand: Decomposition | None,
        sampling: dict[str, Any],
    ) -> Decomposition:
        if at_hand is None:
            return self.decompose(picture, cover, **sampling)
        check_decomposition(at_hand, picture, cover, sampling)
        return at_hand

    def _rerender(
        self,
        picture: Float[np.ndarray, "h w 3"],
        cover: Float[np.ndarray, "h w 1"],
        before: Intrinsics,
        edited: Intrinsics,
        anchored: bool,
        sampling: dict[str, Any],
        derived: Collection[str] = (),
    ) -> Float[np.ndarray, "h w 3"]:
        """The picture of the edited maps (h, w, 3), linear, premultiplied; anchored: the picture times what the edit
        changes.
        """
        names = ("mode", "num_inference_steps", "num_samples")
        settings = {name: sampling[name] for name in names if name in sampling}
        settings["step_end"] = step_end_of(self, sampling.get("callback_on_step_end"))
        network = self._network(sampling.get("mode", "mean"), sampling.get("sampler"), sampling.get("size"))
        # Both renders see the same noise, so that it cancels in what changes.
        seed = Sampling.of(**settings, generator=sampling.get("generator")).draw_seed()
        first, second = (Sampling.of(**settings, generator=own) for own in same_noise(seed, 2))
        (image,) = render_any_size(network, [edited], first, self._report_overflow, derived)
        if anchored:
            (unedited,) = render_any_size(network, [before], second)
            image = anchor(srgb_decode(picture) * cover, unedited, image)
        self.maybe_free_model_hooks()
        return image
