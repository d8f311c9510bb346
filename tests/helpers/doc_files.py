"""Blocks of the documentation that are files of data: each is read by the code that reads such files.

A reader gets the text and an empty working folder. It fails where the file would be refused, or read as something else.
"""

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from doc_blocks import DOCS, blocks
from inline_executor import Inline
from PIL import Image

from unirender.training.data.groups import read_groups
from unirender_evaluation.predictions.conventions import read_conventions
from unirender_evaluation.public.iiw import Iiw
from unirender_evaluation.public.maw import Maw
from unirender_reference.dataset import generate
from unirender_reference.dataset_config import DatasetConfig
from unirender_reference.optimize.files.folder import read_views
from unirender_reference.shards import Failure

Reader = Callable[[str], object]

LANGUAGES = ("json", "toml", "yaml", "text")


def picture(path: Path, mode: str = "RGB", side: int = 12) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    levels = np.zeros((side, side, len(mode)), np.uint8)
    levels[3:-3, 3:-3] = 255  # of RGBA, the alpha channel too: an object in the middle
    Image.fromarray(levels[..., 0] if mode == "L" else levels, mode).save(path)


def failure(text: str) -> None:
    entry = json.loads(text)
    assert Failure(**entry).entry() == entry


def pair_record(text: str) -> None:
    """An entry like those of a group that is written now."""
    shown = json.loads(text)
    generate(DatasetConfig(1, 3, 8, "independent", Path("set"), spp=16, workers=1), executor=Inline())
    groups = [json.loads(members["json"]) for path in Path("set").glob("*.tar") for _, members in read_groups(path)]
    written = [pair for group in groups for light in group["lights"] for pair in light["pairs"]]
    assert written
    for pair in written:
        percents = (round(100 * pair["metallic"]), round(100 * pair["roughness"]))
        light = pair["member"].partition(".")[0]
        assert pair["member"] == "{}.m{:03d}_r{:03d}.exr".format(light, *percents), "the page's pattern of names"
        assert pair["specular"] == f"{light}.r{percents[1]:03d}.specular.exr"
        assert pair.keys() == shown.keys()
    assert shown == {
        "roughness": 0.3,
        "metallic": 0.5,
        "member": "l0.m050_r030.exr",
        "specular": "l0.r030.specular.exr",
    }


def views(text: str) -> None:
    picture(Path("images/0001.png"), "RGBA")
    picture(Path("images/0002.png"))
    picture(Path("masks/0002.png"), "L")
    Path("transforms.json").write_text(text, encoding="utf-8")
    found = read_views(".")
    assert (len(found.seen), len(found.held_out)) == (1, 1)
    for view in (*found.seen, *found.held_out):
        np.testing.assert_allclose(view.pose[:3, :3] @ view.pose[:3, :3].T, np.eye(3), atol=1e-6)
        assert view.mask.mean() == pytest.approx(0.25)


def iiw(text: str) -> None:
    Path("1.json").write_text(text, encoding="utf-8")
    picture(Path("1.png"))
    assert [sample.key for sample in Iiw(Path()).samples()] == ["1"]


def maw(text: str) -> None:
    Path("labels/colors").mkdir(parents=True)
    Path("labels/meta.csv").write_text(text.replace("<TAB>", "\t"), encoding="utf-8")
    np.save("labels/colors/DSC1.npy", np.full((1, 3), 0.5))
    picture(Path("labels/colors/DSC1_mask.png"), "L")
    picture(Path("images_png/scene_0/DSC1.png"))
    assert len(Maw(Path()).samples()) == 1


def slurm(text: str) -> None:
    """A job of dask-jobqueue with what the page says: its cores, its queue, its time."""
    import yaml
    from dask import config as dask_config
    from dask_jobqueue.slurm import SLURMJob

    merged = dask_config.merge(dask_config.config, yaml.safe_load(text))  # as dask reads the file over its defaults
    with dask_config.set({"jobqueue": merged["jobqueue"]}):
        script = SLURMJob(scheduler="tcp://127.0.0.1:1", name="worker", processes=32).job_script()
    for words in (
        "#SBATCH -p cpu",
        "#SBATCH --cpus-per-task=32",
        "#SBATCH -t 04:00:00",
        "--interface ib0",
        "--lifetime 225m",
    ):
        assert words in script, script


def conventions(text: str) -> None:
    """What the comments of the page say is not the default, all of it."""
    Path("conventions.toml").write_text(text, encoding="utf-8")
    found = read_conventions(Path())
    assert (found.normal_axes, found.exr_colour, found.png_colour) == (("+x", "-y", "-z"), "srgb", "linear")
    assert (found.roughness, found.premultiplied) == ("alpha", False)


def distribution(text: str) -> None:
    """hatchling takes it, and its entry point is the class that the page shows."""
    from hatchling.metadata.core import ProjectMetadata

    project: dict[str, Any] = tomllib.loads(text)
    metadata = ProjectMetadata(".", None, project).core
    (target,) = metadata.entry_points["unirender.methods"].values()
    module, _, name = target.partition(":")
    shown = [block.text for block in blocks(DOCS / "score_your_method.md") if block.text.startswith(f"# {module}.py\n")]
    assert len(shown) == 1
    assert f"class {name}:" in shown[0]
    assert project["tool"]["hatch"]["build"]["targets"]["wheel"]["only-include"] == [f"{module}.py"]


READERS: dict[str, tuple[Reader, ...]] = {
    "dataset.md": (failure, pair_record),
    "optimization.md": (views,),
    "public_test_sets.md": (iiw, maw),
    "scaling.md": (slurm,),
    "score_your_method.md": (conventions, distribution),
}
"""By the page's name: one reader for each block of data, in their order."""
