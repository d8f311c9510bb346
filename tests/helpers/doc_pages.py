"""What the examples of the documentation assume, page by page: files and names that a reader would have, made small."""

import dataclasses
import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from accelerate.tracking import GeneralTracker, on_main_process
from inline_executor import Inline
from PIL import Image
from reference_scenes import environment, sphere
from synthetic_shards import own_picture, write_dataset
from tiny_models import TRAIN, make_pipeline
from tiny_suites import make_suite

from unirender.color import image_srgb, unpremultiply
from unirender.exr import image_channels, write_exr
from unirender.files import write_result
from unirender.intrinsics import Intrinsics
from unirender.models.dual_stream import DualStreamModel
from unirender.training.data.groups import read_groups
from unirender.visualization import write_png
from unirender_evaluation.export import export_inputs
from unirender_evaluation.predictions.check import folder_problems, questions
from unirender_evaluation.predictions.folder import PredictionFolder
from unirender_evaluation.subsets import Subsets
from unirender_reference.dataset import generate
from unirender_reference.dataset_config import DatasetConfig

Names = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Example:
    """How the Python blocks of a page are run, in an empty working folder.

    Attributes:
        names: makes the files that the page assumes in the working folder; returns the names that it assumes.
        less: words of the page and what is run in their place, so that it takes seconds; each has to be on the page.
        check: looks at what the blocks left, where running through is not enough.
    """

    names: Callable[[], Names] = dict
    less: Mapping[str, str] = dataclasses.field(default_factory=dict)
    check: Callable[[Names], None] = lambda names: None


def straight(image_rgba: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A picture as the model takes it: straight display values and coverage."""
    mask = image_rgba[..., 3:]
    return image_srgb(unpremultiply(image_rgba[..., :3], mask)), mask


def photograph() -> Names:
    shown, mask = straight(own_picture(0, size=64)[0])
    return {"image_srgb": shown, "mask": mask}


def mug() -> Names:
    picture = photograph()
    write_png(Path("mug.png"), np.concatenate([picture["image_srgb"], picture["mask"]], axis=-1))
    facing = picture["mask"] * np.array([0, 0, 1], np.float32)
    even = {"roughness": 0.5 * picture["mask"], "metallic": 0 * picture["mask"], "mask": picture["mask"]}
    Path("mug").mkdir()
    write_result("mug", Intrinsics(albedo=0.5 * picture["image_srgb"], normal=facing, **even), {})
    Image.new("RGB", picture["mask"].shape[1::-1], "red").save("mug/albedo.png")
    return {}


def check_tour(names: Names) -> None:
    np.testing.assert_array_equal(names["edited"].albedo, names["stored"].mask * np.array([1, 0, 0]))
    assert names["chrome"].coarse_share == 1.0, "the page says 1.0"
    assert names["again"].shape == (64, 64, 3)
    assert np.abs(names["other"] - names["again"]).mean() > 0.01, "under another light"


def lights(folder: str, count: int) -> None:
    Path(folder).mkdir()
    for number in range(count):
        radiance = environment(number)
        write_exr(Path(folder) / f"hall_{number}k.exr", image_channels(radiance), half=False)


def own_lights() -> Names:
    lights("my_lights", 3)
    return {}


def data_set() -> Names:
    """`data/train` under built-in lights; a light of another data set, all of whose lights are of `my_hdris`."""
    small: dict[str, Any] = {"objects": 1, "resolution": 8, "spp": 16, "workers": 1}
    generate(DatasetConfig(pairs=3, vary="basis", out=Path("data/train"), **small), executor=Inline())
    lights("my_hdris", 9)
    lit = {"lights": Path("my_hdris"), "light_share": 1.0, "turn_lights": True}
    generate(DatasetConfig(pairs=9, vary="independent", out=Path("lit"), **small, **lit), executor=Inline())
    drawn = [
        light
        for path in sorted(Path("lit").glob("*.tar"))
        for _, members in read_groups(path)
        for light in json.loads(members["json"])["lights"]
    ]
    return {"light": next(light for light in drawn if light["provenance"]["file"] == "hall_8k.exr")}


def models() -> Names:
    """A folder of meshes, the format of the page's glob among them."""
    import trimesh

    Path("models/chairs").mkdir(parents=True)
    trimesh.creation.icosphere(subdivisions=1).export("models/chairs/0042.glb")
    return {}


def check_meshes(names: Names) -> None:
    assert names["obj"].name == "0042"


def own_mesh_and_light() -> Names:
    import trimesh

    trimesh.creation.icosphere(subdivisions=2).export("mug.glb")
    write_exr(Path("hall.exr"), image_channels(environment()), half=False)
    return {}


def check_passes(names: Names) -> None:
    assert names["shadow"].shape == (8, 8, 4)
    assert names["shadow"][..., :3].max() <= 0
    assert names["metal"].shape == (8, 8, 3)


def predicted() -> Names:
    truth = own_picture(0)[1]
    return {"prediction": truth.replace(albedo=truth.require("albedo")["albedo"] * np.float32(0.9)), "truth": truth}


def check_score(names: Names) -> None:
    assert 20 < names["values"]["albedo.psnr@masked-srgb-raw"] < 60


def stranger() -> Names:
    """The inputs of a tiny suite, and the arguments of the script that the page shows."""
    export_inputs(make_suite(Path("suite")), Path("inputs"))
    sys.argv[:] = ["predict.py", "inputs", "predictions"]
    return {"LITTLE": Subsets(0, 1, 1, 0, 0, 0, 0)}


def check_predictions(names: Names) -> None:
    suite = make_suite(Path("again"))
    asked = {path.parent.name for path in Path("inputs").glob("*/meta.json") if '"intrinsics": {' in path.read_text()}
    assert {path.parent.name for path in Path("predictions").glob("*/*")} == asked, "maps where maps are asked for"
    assert not folder_problems(PredictionFolder(Path("predictions")), questions(suite), "ball")
    rows = {row.pop("method"): row for row in names["rows"]}
    own, folder = rows["retinex"]["albedo.psnr@masked-srgb-raw"], rows["mine"]["albedo.psnr@masked-srgb-raw"]
    assert own.mean == pytest.approx(folder.mean, abs=1e-4)
    of_samples = [record.values for record in names["result"].records if record.method == "retinex"]
    assert names["values"]["albedo.psnr@masked-srgb-raw"] in [
        values.get("albedo.psnr@masked-srgb-raw") for values in of_samples
    ], "a question's score is that of the run"


def other_method() -> Names:
    """What a method may have written of the pictures of a tiny suite, four times as large and over white."""
    export_inputs(make_suite(Path("suite")), Path("inputs"))
    for path in sorted(Path("inputs").glob("*/image.png")):
        picture, shown = path.parent.name, np.asarray(Image.open(path))
        over_white = Image.fromarray(np.where(shown[..., 3:] > 0, shown[..., :3], np.uint8(255)))
        large = over_white.resize((4 * over_white.width, 4 * over_white.height), Image.Resampling.BICUBIC)
        for name in (f"{picture}/0000.basecolor.jpg", f"rough/{picture}.png", f"depth/{picture}.png"):
            target = Path("written") / name
            target.parent.mkdir(parents=True, exist_ok=True)
            kept = large.convert("RGB" if "base" in name else "L")
            if "rough" in name:
                kept = Image.fromarray(np.asarray(kept).astype(np.uint16) * 257)  # 16 bits
            kept.save(target, quality=100)
    sys.argv[:] = ["gather.py", "inputs", "written", "predictions"]
    return {}


def check_gathered(names: Names) -> None:
    """All is found and fits, and less of the white behind is in its colours than in those of a plain reduction."""
    predictions = Path("predictions")
    assert not folder_problems(PredictionFolder(predictions), questions(make_suite(Path("again"))), "ball")
    assert {path.name for path in predictions.glob("*/*")} == {"albedo.png", "roughness.png"}
    for path in predictions.glob("*/albedo.png"):
        shown, found = (Image.open(each) for each in (Path("inputs") / path.parent.name / "image.png", path))
        plain = Image.open(Path("written") / path.parent.name / "0000.basecolor.jpg").resize(
            shown.size, Image.Resampling.BOX
        )
        true, *others = (np.asarray(each, np.float64) for each in (shown, found, plain))
        error, plain_error = (np.sum(true[..., 3:] * (each - true[..., :3]) ** 2) for each in others)
        assert error < 0.6 * plain_error
        rough, grey = (np.asarray(Image.open(each).convert("L")) for each in (path.with_name("roughness.png"), path))
        inside = true[..., 3] == 255
        assert abs(np.mean(rough[inside], dtype=float) - np.mean(grey[inside], dtype=float)) < 8, "16 bits as 8"


def shaded() -> Names:
    maps = own_picture(0)[1]
    gradient = np.ones((16, 16, 3), np.float32)
    obj = sphere(subdivisions=2)
    return {"intrinsics": maps, "environment": environment(), "image_gradient": gradient, "obj": obj}


def check_gradients(names: Names) -> None:
    assert names["image"].shape == (16, 16, 3)
    assert np.abs(names["gradients"].albedo).max() > 0
    assert names["losses"][-1] < 0.4 * names["losses"][0]


class MyTracker(GeneralTracker):
    """A tracker as accelerate's documentation shows one; it keeps what it is told."""

    name = "mine"
    requires_logging_directory = False

    told: ClassVar[list[dict[str, Any]]] = []

    def __init__(self, run_name: str = "") -> None:
        super().__init__()

    @property
    def tracker(self) -> list[dict[str, Any]]:
        return self.told

    @on_main_process
    def store_init_configuration(self, values: dict[str, Any]) -> None:
        self.told.append(values)

    @on_main_process
    def log(self, values: dict[str, Any], step: int | None = None, **options: Any) -> None:
        self.told.append(values)


def training() -> Names:
    """Pictures with maps, and a data set."""
    MyTracker.told.clear()
    write_dataset(Path("data"), size=32)
    pictures = {"mug": own_picture(0), "cup": own_picture(1)}
    return {
        "pictures": pictures,
        "MyTracker": MyTracker,
        "SMALL": dataclasses.replace(TRAIN, batch_size=2),
        "make_pipeline": make_pipeline,
    }


def check_training(names: Names) -> None:
    for run in ("colour_first", "tracked"):
        config = json.loads(Path(run, "config.json").read_text(encoding="utf-8"))
        assert config["train"]["loss"]["albedo"] == 4.0
        assert Path(run, "pipeline", "model_index.json").is_file()
    assert any("albedo" in values for values in MyTracker.told)
    assert {"image", "albedo", "cycle"} <= names["terms"].keys()
    trained, stored = names["network"], DualStreamModel.from_pretrained("mine-pipeline", subfolder="dual_stream")
    assert all(torch.equal(p, q) for p, q in zip(trained.parameters(), stored.parameters(), strict=True))


def optimizer() -> Names:
    """The two classes that the smaller configuration names; the page needs nothing else."""
    from unirender_reference.optimize.refine.config import RefineConfig
    from unirender_reference.optimize.transport.config import TransportConfig

    return {"RefineConfig": RefineConfig, "TransportConfig": TransportConfig}


OPTIMIZE = """OptimizeConfig(
    transport=TransportConfig(pixels=300, fine_below=0.0, iterations=1, rounds=0),
    refine=RefineConfig(iterations=2, spp=4, spp_gradient=4, depth=2),
    texture_size=16,
    light_rows=8,
)"""
SINGLE = "SingleConfig(coarse_pixels=150, pixels=300, steps=(1, 1, 1), fine_steps=1, light_rows=8)"


def check_optimized(names: Names) -> None:
    views = names["views"]
    assert (len(views.seen), len(views.held_out)) == (2, 1)
    assert Path("found/solution.json").is_file()
    assert names["found"].albedo.shape == (24, 24, 3)
    assert np.asarray(names["image"])[..., 3].max() > 0.9


def printed_as_said(names: Names) -> None:
    assert names["inside"](names["samples"], names["stated"]).mean() == pytest.approx(0.75), "the page says 0.75"


EXAMPLES = {
    "README.md": Example(mug),
    "dataset.md": Example(data_set),
    "figures.md": Example(),
    "lights.md": Example(own_lights),
    "materials.md": Example(less={"metallic=0.5)": "metallic=0.5, resolution=16)", "spp=64": "spp=8"}),
    "meshes.md": Example(models, check=check_meshes),
    "model.md": Example(),
    "optimization.md": Example(
        optimizer,
        {
            "resolution=64": "resolution=24",
            "orbit(9, camera)": "orbit(3, camera)",
            "spp=64": "spp=16",
            "OptimizeConfig()": OPTIMIZE,
            "place=place)": "place=place, pictures=False, threads=1)",
            "SingleConfig()": SINGLE,
        },
        check_optimized,
    ),
    "passes.md": Example(own_mesh_and_light, {"spp=1152": "spp=144", "resolution=128": "resolution=8"}, check_passes),
    "physics.md": Example(check=printed_as_said),
    "results_format.md": Example(predicted, check=check_score),
    "score_your_method.md": Example(
        stranger,
        {
            '"tiny"': '"suite/ball.toml"',
            "scenes[:2]": "scenes[:1]",
            "limit=2": "limit=1, check_scenes=0, jobs=0, subsets=LITTLE",
        },
        check_predictions,
    ),
    "shade.md": Example(shaded, {"spp=256": "spp=16", "spp=64": "spp=16"}, check_gradients),
    "your_files.md": Example(other_method, check=check_gathered),
    "tour.md": Example(mug, {"resolution=128": "resolution=32", "spp=256": "spp=16"}, check_tour),
    "training.md": Example(
        training,
        {
            "minutes=30": "steps=1",
            'PRESETS["tiny"]': "SMALL",
            'UniRenderPipeline.from_pretrained("tiny", calibration=None)': "make_pipeline()",
            'Batches("data", 16)': 'Batches("data", 4)',
            "10 * len": "len",
            "num_workers=2": "num_workers=0",
        },
        check_training,
    ),
}
"""By the page's name. An example that needs nothing is `Example()`."""
