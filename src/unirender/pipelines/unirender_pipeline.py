"""`UniRenderPipeline`: decompose, render, edit and relight with one dual-stream model.

It is a diffusers pipeline (`from_pretrained`, `save_pretrained`, `to`, `torch_dtype`, progress bars) whose public
arrays are numpy. A *picture* is straight display values like a PNG's, with its mask beside it; a *linear image* that
comes back is premultiplied. Any size: pictures are brought to the model's square and results back
(`unirender.pipelines.framing`).
"""

import logging
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from diffusers.pipelines.pipeline_utils import DiffusionPipeline
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from jaxtyping import Float
from PIL import Image

from unirender.camera import Camera
from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.models.codec import make_codec
from unirender.models.conditioning import Conditioning
from unirender.models.dual_stream import DualStreamModel
from unirender.pipelines.closure import close_decomposition
from unirender.pipelines.editing import anchor, constant_map, specular_for_roughness, under_light
from unirender.pipelines.framing import Frame
from unirender.pipelines.inputs import as_environment, as_picture, ready_to_render, unit_value
from unirender.pipelines.network import Network, Overflow
from unirender.pipelines.rendering import enter, render_any_size
from unirender.pipelines.results import Decomposition, EditResult, combine, predicted_intrinsics
from unirender.pipelines.settings import Sampling

SHIPPED_CHECKPOINT = Path(__file__).parent.parent / "checkpoints" / "tiny"

Picture = np.ndarray | Image.Image  # shapes and ranges are checked in `unirender.pipelines.inputs`

logger = logging.getLogger(__name__)


class UniRenderPipeline(DiffusionPipeline):
    """One dual-stream model in both directions.

    Args:
        dual_stream: the network.
        scheduler: with zero terminal SNR and `prediction_type="sample"`.
        vae: for models with the KL codec.
        material: whether metallic and roughness are one number per object or maps, as the checkpoint was trained.
    """

    model_cpu_offload_seq = "dual_stream"
    _optional_components: ClassVar[list[str]] = ["vae"]

    def __init__(
        self,
        dual_stream: DualStreamModel,
        scheduler: DDIMScheduler,
        vae: AutoencoderKL | None = None,
        material: str = "scalar",
    ) -> None:
        super().__init__()
        self.register_modules(dual_stream=dual_stream, scheduler=scheduler, vae=vae)
        self.register_to_config(material=material)
        self.dual_stream: DualStreamModel
        self.scheduler: DDIMScheduler
        codec = make_codec(dual_stream.config["codec"], dual_stream.config["patch"], vae)
        self.conditioning = Conditioning.of(dict(dual_stream.config), codec)
        self.size = dual_stream.config["sample_size"] * codec.factor
        self._reported: set[str] = set()  # maps whose overflow was logged

    @classmethod
    def from_pretrained(  # pyright: ignore[reportIncompatibleMethodOverride] - a path may be left out here
        cls, pretrained_model_name_or_path: str | Path | None = None, **kwargs: Any
    ) -> "UniRenderPipeline":
        """Loads a pipeline folder; the shipped `tiny` without one. Weights become float32 without `torch_dtype`.

        Raises:
            UnirenderError: no such folder, or no pipeline in it.
        """
        path = Path(pretrained_model_name_or_path or SHIPPED_CHECKPOINT)
        if not (path / "model_index.json").is_file():
            inside = path / "pipeline"
            if (inside / "model_index.json").is_file():
                raise UnirenderError(f"{path}: is the folder of a training run; its pipeline is {inside}")
            raise UnirenderError(
                f"{path}: no pipeline folder (model_index.json is missing), expected one written by `unirender train`"
            )
        old_name = kwargs.pop("torch_dtype", None)  # diffusers calls it `dtype` now; both work here
        kwargs = {"dtype": old_name or torch.float32, "use_safetensors": True} | kwargs
        return super().from_pretrained(str(path), **kwargs)

    def __call__(self, image: Any, mask: Any = None, **kwargs: Any) -> Decomposition:
        """The same as `decompose`."""
        return self.decompose(image, mask, **kwargs)

    def decompose(
        self,
        image_srgb: Picture,
        mask: Picture | None = None,
        *,
        camera: Camera | None = None,
        mode: str = "mean",
        num_inference_steps: int | None = None,
        num_samples: int | None = None,
        generator: torch.Generator | None = None,
        material: str | None = None,
        closed: bool = True,
    ) -> Decomposition:
        """Inverse rendering.

        Args:
            image_srgb: display values [h w 3] in [0, 1], not premultiplied, or a PIL picture.
            mask: coverage [h w 1] in [0, 1]; None: a PIL picture's alpha, else the whole frame.
            camera: the contract's default if None.
            mode: `mean` (one step, the expectation) or `sample` (diffusion samples: their mean and spread).
            num_inference_steps: of `sample`; 20 if None.
            num_samples: of `sample`; 5 if None.
            generator: a CPU generator for the noise; None: a fixed noise in mode `mean` (an expectation depends on no
                draw), torch's global state in mode `sample`.
            material: one number per object or maps; None: as the checkpoint was trained.
            closed: change albedo, s and d so that their rendering is the picture (`unirender.pipelines.closure`); False
                gives what the network predicts.

        Raises:
            UnirenderError: the picture, the mask or a setting is not usable; the message says why.
        """
        picture, cover = as_picture(image_srgb, mask)
        how = Sampling.of(mode, num_inference_steps, num_samples, generator)
        camera, material = camera or Camera(), material or self.config["material"]
        if material not in ("scalar", "map"):
            raise UnirenderError(f"material: got {material!r}, expected 'scalar' or 'map'")
        frame, image_linear = Frame(picture.shape[0], picture.shape[1], self.size), srgb_decode(picture) * cover
        found = self._network.attributes(frame.enter(image_linear), frame.enter(cover), frame.camera(camera), how)
        samples = [predicted_intrinsics(maps, frame, cover, camera, material) for maps in found]
        if closed:

            def render(maps: Intrinsics) -> Float[np.ndarray, "h w 3"]:
                return render_any_size(self._network, maps, Sampling.of())

            samples = [close_decomposition(sample, image_linear, render) for sample in samples]
        return combine(tuple(samples))

    def render(
        self,
        intrinsics: Intrinsics,
        *,
        mode: str = "mean",
        num_inference_steps: int | None = None,
        num_samples: int | None = None,
        generator: torch.Generator | None = None,
    ) -> Float[np.ndarray, "h w 3"]:
        """Rendering; several samples are averaged in linear light.

        Args:
            intrinsics: normal, roughness and metallic are needed; albedo, specular, diffuse and environment may be
                missing, and a missing mask is the whole frame. Missing s and d are derived from the environment
                (without shadows) where it is given.

        Returns:
            Premultiplied linear image at the intrinsics' size, in [0, 1].

        Raises:
            UnirenderError: a map that is needed is missing, or a setting is not usable.
        """
        how = Sampling.of(mode, num_inference_steps, num_samples, generator)
        return render_any_size(self._network, intrinsics, how, self._report_overflow)

    def overflow(self, intrinsics: Intrinsics) -> dict[str, Overflow]:
        """Which of s, d and environment exceed, at the model's size, the brightest that the network was taught.

        Such values are not clipped: they enter above the range of the training data. `render` logs them, once a map.

        Returns:
            By name of the map; {} where nothing does.
        """
        network = self._network
        return network.overflow(enter(network, ready_to_render(intrinsics))[1])

    def edit(
        self,
        image_srgb: Picture,
        mask: Picture | None = None,
        *,
        roughness: Float[np.ndarray, "h w 1"] | float | None = None,
        metallic: Float[np.ndarray, "h w 1"] | float | None = None,
        anchored: bool = True,
        decomposition: Decomposition | None = None,
        **sampling: Any,
    ) -> EditResult:
        """Decomposes, changes the material, derives s for the new roughness, renders.

        Args:
            image_srgb: as for `decompose`.
            mask: as for `decompose`.
            roughness: new value or map, [0, 1]; None: unchanged.
            metallic: new value or map, [0, 1]; None: unchanged.
            anchored: the change is applied to the input (`unirender.pipelines.editing.anchor`); else the plain render.
            decomposition: of this picture, if it is at hand.
            **sampling: camera, mode, num_inference_steps, num_samples, generator, as for `decompose`.

        Raises:
            UnirenderError: as `decompose`; or nothing to change; or a value outside [0, 1].
        """
        if roughness is None and metallic is None:
            raise UnirenderError("edit: nothing to change, expected roughness or metallic (or both)")
        picture, cover = as_picture(image_srgb, mask)
        decomposition = decomposition or self.decompose(picture, cover, **sampling)
        before = decomposition.intrinsics
        edited, bounded = before, 0.0
        if metallic is not None:
            edited = edited.replace(metallic=constant_map(unit_value("metallic", metallic), cover))
        if roughness is not None:
            target = constant_map(unit_value("roughness", roughness), cover)
            specular, bounded = specular_for_roughness(before, target)
            edited = edited.replace(roughness=target, specular=specular)
        image = self._rerender(picture, cover, before, edited, anchored, sampling)
        return EditResult(image, edited, decomposition, bounded)

    def relight(
        self,
        image_srgb: Picture,
        environment: np.ndarray | None,
        mask: Picture | None = None,
        *,
        exposure: str = "auto",
        anchored: bool = True,
        specular: Float[np.ndarray, "h w 3"] | None = None,
        diffuse: Float[np.ndarray, "h w 3"] | None = None,
        decomposition: Decomposition | None = None,
        **sampling: Any,
    ) -> EditResult:
        """Decomposes, puts the object under another light, renders.

        s and d are derived from the predicted normal and roughness at the light's own resolution (without shadows),
        unless they are given.

        Args:
            image_srgb: as for `decompose`.
            environment: lat-long radiance [eh ew 3] in camera axes, any size; None where both s and d are given.
            mask: as for `decompose`.
            exposure: `auto` scales the light so that white under it is as bright as in the training data; `keep` not.
            anchored: as for `edit`.
            specular: s under the new light, if known.
            diffuse: d under the new light, if known.
            decomposition: of this picture, if it is at hand.
            **sampling: as for `edit`.

        Raises:
            UnirenderError: as `decompose`; or neither a light nor both s and d are given.
        """
        if environment is None and (specular is None or diffuse is None):
            raise UnirenderError("relight: no light, expected an environment, or both specular and diffuse")
        picture, cover = as_picture(image_srgb, mask)
        if environment is not None:
            environment = as_environment(environment)
        decomposition = decomposition or self.decompose(picture, cover, **sampling)
        before = decomposition.intrinsics
        if environment is not None:
            edited = under_light(before, environment, exposure, specular, diffuse, mirrors=False)
        else:
            edited = before.replace(environment=None, specular=specular, diffuse=diffuse)
        image = self._rerender(picture, cover, before, edited, anchored, sampling)
        return EditResult(image, edited, decomposition)

    def _rerender(
        self,
        picture: Float[np.ndarray, "h w 3"],
        cover: Float[np.ndarray, "h w 1"],
        before: Intrinsics,
        edited: Intrinsics,
        anchored: bool,
        sampling: dict[str, Any],
    ) -> Float[np.ndarray, "h w 3"]:
        names = ("mode", "num_inference_steps", "num_samples")
        settings = {name: sampling[name] for name in names if name in sampling}
        # Both renders see the same noise, so that it cancels in what changes.
        seed = Sampling.of(**settings, generator=sampling.get("generator")).draw_seed()
        after = self.render(edited, generator=torch.Generator().manual_seed(seed), **settings)
        if not anchored:
            return after
        again = Sampling.of(**settings, generator=torch.Generator().manual_seed(seed))
        return anchor(srgb_decode(picture) * cover, render_any_size(self._network, before, again), after)

    @property
    def _network(self) -> Network:
        return Network(self.dual_stream, self.conditioning, self.scheduler, self.size, self._progress)

    def _progress(self, steps: Iterable[Any]) -> Iterable[Any]:
        return self.progress_bar(steps)  # pyright: ignore[reportReturnType, reportCallIssue, reportArgumentType] - tqdm

    def _report_overflow(self, overflow: dict[str, Overflow]) -> None:
        for name, over in overflow.items():
            if name not in self._reported:
                self._reported.add(name)
                logger.warning("%s: %s; they are kept, but what it makes of them is a guess", name, over)
