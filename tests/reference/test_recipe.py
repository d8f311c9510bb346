"""Recipes: training sets in parts, refused as a whole before anything is rendered."""

from pathlib import Path

import pytest
import trimesh
from inline_executor import Inline

from unirender.errors import UnirenderError, UsageError
from unirender.training.data.dataset import GroupDataset
from unirender_reference.commands import Dataset
from unirender_reference.dataset import generate
from unirender_reference.recipe import read_recipe

RECIPE = """
title = "two parts"
assets_from = "a shop for meshes"
[common]
resolution = 16
spp = 16
pairs = 3
[parts.procedural]
objects = 1
[parts.real]
meshes = "shapes"
pairs = 6
"""


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    """A recipe, and beside it `assets/shapes` with one mesh."""
    shapes = tmp_path / "assets" / "shapes"
    shapes.mkdir(parents=True)
    trimesh.creation.icosphere(subdivisions=1).export(shapes / "ball.obj")
    path = tmp_path / "mine.toml"
    path.write_text(RECIPE)
    return path


@pytest.mark.parametrize("name", ["train-64", "train-128", "visibility"])
def test_the_package_s_recipes_leave_the_test_meshes_out(name: str, tmp_path: Path) -> None:
    made = read_recipe(name)
    catalogues = {str(part["meshes"]) for part in made.parts.values() if "meshes" in part}
    assert len(catalogues) == 4
    assert "Reallusion" not in catalogues
    for catalogue in catalogues:
        (tmp_path / catalogue).mkdir()
    parts = Dataset(out=tmp_path / "out", recipe=name, assets=tmp_path).parts()
    assert all(part.holdout == 8 and part.split == "train" for part in parts.values() if part.meshes is not None)
    assert {part.resolution for part in parts.values()} == {64 if name == "train-64" else 128}


def test_every_part_is_rendered_into_a_folder_of_its_own(recipe: Path, tmp_path: Path) -> None:
    """Training reads the parts together; the command finds them complete."""
    command = Dataset(out=tmp_path / "out", recipe=str(recipe), assets=tmp_path / "assets", workers=1)
    for part in command.parts().values():
        generate(part.check(), executor=Inline())
    data = GroupDataset(tmp_path / "out")
    assert data.shard_names == ("procedural/shard-000000.tar", "real/shard-000000.tar")
    assert [len(data.pairs(i)) for i in range(len(data.keys))] == [3, 6]
    stamps = [path.stat().st_mtime_ns for path in sorted(tmp_path.glob("out/*/*.tar"))]
    assert command.run() == 0
    assert [path.stat().st_mtime_ns for path in sorted(tmp_path.glob("out/*/*.tar"))] == stamps


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("objects = 1", "objects = 'one'", "objects is 'one', expected int"),
        ("objects = 1", "objects = true", "objects is True, expected int"),
        ("spp = 16", "samples = 16", "common: unknown option 'samples'"),
        ("[parts.real]", "[parts.Real]", "part 'Real': expected a-z"),
        ('"shapes"', '"../shapes"', "expected a folder below --assets"),
        ("title", "name", "unknown key 'name'"),
        ("[common]", "[common", "is not TOML"),
    ],
)
def test_what_is_wrong_with_a_recipe_is_named(recipe: Path, old: str, new: str, named: str) -> None:
    recipe.write_text(RECIPE.replace(old, new, 1))
    with pytest.raises(UnirenderError) as caught:
        read_recipe(str(recipe))
    assert named in str(caught.value)


def test_all_parts_are_checked_before_anything_is_rendered(recipe: Path, tmp_path: Path) -> None:
    out, assets = tmp_path / "out", tmp_path / "assets"

    def refused(kind: type[UnirenderError], message: str, **options: object) -> None:
        command = Dataset(**{"out": out, "recipe": str(recipe), "assets": assets, **options})  # pyright: ignore[reportArgumentType] - as the command line gives them
        with pytest.raises(kind, match=message):
            command.run()
        assert not out.exists()

    refused(UsageError, r"--resolution: got it beside --recipe", resolution=32)
    refused(UsageError, "needs the folders shapes; pass --assets", assets=None)
    refused(UnirenderError, r"no folder shapes in it.*a shop for meshes", assets=tmp_path / "out")
    refused(UsageError, "expected one of train-128, train-64, visibility", recipe="train-65")
    refused(UsageError, "--assets: got it without --recipe", recipe=None)
    recipe.write_text(RECIPE.replace("pairs = 6", "pairs = 7"))
    refused(UsageError, "part real: dataset pairs: got 7")
