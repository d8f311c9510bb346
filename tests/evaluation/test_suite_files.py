"""Suites of files: which meshes and lights a TOML file takes, what is refused, and where made suites are found."""

import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from tiny_suites import write_suite

from unirender.cli import main
from unirender.errors import UnirenderError
from unirender.system.whole_files import file_sha256
from unirender_evaluation.lpips import SMALLEST
from unirender_evaluation.results import check as results_check
from unirender_evaluation.results.listing import suites as listed_suites
from unirender_evaluation.suites import home as suite_home
from unirender_evaluation.suites.check import LEAST
from unirender_evaluation.suites.definition import DEFINITION, check_definition
from unirender_evaluation.suites.definition import recorded as recorded_values
from unirender_evaluation.suites.home import definition, found_spec, home, target, truth_command, with_folder
from unirender_evaluation.suites.lights import SuiteLight, assign_lights, light_sources, load_lights
from unirender_evaluation.suites.objects import broken_meshes, scene_object, suite_sources
from unirender_evaluation.suites.spec import SuiteSpec, parse_spec, read_spec, suite_path
from unirender_evaluation.suites.suite import Suite, load_suite
from unirender_evaluation.suites.truth_file import list_tar, write_tar
from unirender_evaluation.truth.make import make_truth
from unirender_evaluation.truth.sources import check_files
from unirender_reference.mesh_folder import MeshFile, mesh_folder
from unirender_reference.recipe import read_recipe

MESHES = '\n[folders]\nobjects = "models"\n\n[[meshes]]\nfiles = "*"\n'


def write_meshes(folder: Path, names: list[str]) -> None:
    """Boxes of different sides."""
    for number, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        trimesh.creation.box((1, 1, 0.5 + 0.2 * number)).export(path)


def write_pictures(folder: Path, count: int) -> None:
    """Grey noise as PNG: light pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    for number in range(count):
        Image.fromarray(rng.integers(0, 256, (16, 24, 3), np.uint8)).save(folder / f"{number}.png")


def spec_with(folder: Path, more: str, **changes: str) -> SuiteSpec:
    """The tiny suite's file with other values and further tables, in a folder."""
    text = suite_path("tiny").read_text()
    for name, value in changes.items():
        text, count = re.subn(rf"^{name} = .*$", f"{name} = {value}", text, flags=re.MULTILINE)
        assert count == 1, name
    return parse_spec(text + more, folder / "my.toml")


def test_standard_is_a_third_real_and_its_constant_scores_a_tenth() -> None:
    """What the suite promises: 100 objects, unseen by tiny, stratified materials, every light about equally often."""
    spec = read_spec("standard")
    meshes = sum(group.count or 0 for group in spec.meshes)
    assert len(spec.objects) + meshes == 100
    assert meshes >= 34
    assert spec.split == "test"
    assert spec.resolution == 128
    assert not set(spec.objects) & set(read_spec("tiny").objects)
    materials = np.array(spec.materials(meshes))
    np.testing.assert_allclose(((materials - 0.5) ** 2).mean(axis=(0, 1)), 0.1, rtol=0, atol=0.002)
    names = list(light_sources(spec))
    assert len(names) == spec.bundled_lights + len(spec.procedural_lights)
    assigned = assign_lights(spec, names, 100)
    counts = [sum(light == name for light, _ in assigned) for name in names]
    assert max(counts) - min(counts) <= 1
    assert all(first[0] != second[0] for first, second in zip(assigned[::2], assigned[1::2], strict=True))


@pytest.mark.parametrize("recipe", ["train-64", "train-128", "visibility"])
def test_no_mesh_of_standard_is_in_a_training_recipe(recipe: str, tmp_path: Path) -> None:
    """The suite lists all catalogues at once, a recipe each for itself: both must count alike, at any depth."""
    catalogues = ("BlendSwap-CC-0", "BlendSwap-CC-BY", "KatorLegaz", "Reallusion", "Scopia")
    for number, catalogue in enumerate(catalogues):
        for i in range(125 + number):
            path = tmp_path / catalogue / ("a" * (i % 3)) / f"{i % 7}{'/deep' * (i % 2)}" / f"{i}.obj"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
    suite = replace(target("standard", None, tmp_path)[0], ceiling_scenes=())
    test = {str(source.name) for source in suite_sources(suite) if isinstance(source.origin, MeshFile)}
    assert len(test) == 40
    train: set[str] = set()
    for part in read_recipe(recipe).parts.values():
        if "meshes" in part:
            files = mesh_folder(tmp_path / part["meshes"], "train", part["holdout"])
            train |= {f"{part['meshes']}/{name}" for name in files.names}
    assert len(train) > 400
    assert not train & test
    everything = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.obj")}
    assert test <= everything >= train  # they are named alike, or the comparison above would be of no worth


def test_paper_takes_every_file_of_two_folders(tmp_path: Path) -> None:
    spec = read_spec("paper")
    assert (spec.resolution, spec.objects, spec.bundled_lights, spec.procedural_lights) == (1024, (), 0, ())
    write_meshes(tmp_path / "models", ["b.glb", "a/c.glb"])
    write_pictures(tmp_path / "lights", 3)
    spec, text = target("paper", tmp_path / "out", tmp_path / "models", tmp_path / "lights")
    assert spec.path == tmp_path / "out" / "paper.toml"
    assert parse_spec(text, spec.path) == spec
    assert [source.name for source in suite_sources(spec)] == ["b.glb", "a/c.glb"]
    assert len(light_sources(spec)) == 3
    assert definition(spec) == definition(read_spec("paper"))


@pytest.mark.parametrize("lights", [2, 3, 5])
def test_lights_of_an_object_differ_whatever_their_number(lights: int) -> None:
    """Three lights for two of each object: a draw of all scenes at once would hardly ever succeed."""
    names = [f"light-{i}" for i in range(lights)]
    assigned = assign_lights(read_spec("tiny"), names, 100)
    assert all(a[0] != b[0] for a, b in zip(assigned[::2], assigned[1::2], strict=True))
    counts = [sum(light == name for light, _ in assigned) for name in names]
    assert max(counts) - min(counts) <= 1


def test_meshes_are_drawn_by_pattern_split_and_seed(tmp_path: Path) -> None:
    """Every 3rd of a pattern for the test split, the others for the training split; a draw is a pure function of its
    seed, and other seeds give other files."""
    names = [f"a/{i:02d}.obj" for i in range(12)] + [f"b/{i:02d}.obj" for i in range(4)]
    write_meshes(tmp_path / "models", names)

    def chosen(group: str, **changes: str) -> list[str]:
        more = f'\n[folders]\nobjects = "models"\n[[meshes]]\n{group}\n'
        spec = spec_with(tmp_path, more, objects="[]", ceiling_scenes="[]", **changes)
        return [str(source.name) for source in suite_sources(spec)]

    assert chosen('files = "a/*"\nholdout = 3') == [f"a/{i:02d}.obj" for i in (2, 5, 8, 11)]
    assert set(chosen('files = "a/*"\nholdout = 3', split='"train"')) == set(names[:12]) - set(
        chosen('files = "a/*"\nholdout = 3')
    )
    assert chosen('files = "b/*"\nwithout = ["b/01.obj"]') == ["b/00.obj", "b/02.obj", "b/03.obj"]
    draws = {tuple(chosen(f'files = "a/*"\ncount = 4\nseed = {seed}')) for seed in (0, 0, 1, 2)}
    assert len(draws) == 3
    assert all(len(set(draw)) == 4 and list(draw) == sorted(draw) for draw in draws)


def test_objects_are_counted_together_and_twins_are_named_by_path(tmp_path: Path) -> None:
    write_meshes(tmp_path / "models", ["a.obj", "b.obj"])
    spec = spec_with(tmp_path, MESHES, objects="[7]", ceiling_scenes='[[7, 0], ["b.obj", 1]]')
    sources = suite_sources(spec)
    assert [source.name for source in sources] == [7, "a.obj", "b.obj"]
    assert len(spec.materials(2)) == 6
    obj = sources[1].load()
    assert obj.name.startswith("a-")
    assert obj.roughness is None
    assert sources[0].provenance() == {"seed": 7}
    assert sources[1].provenance() == {"file": "a.obj", "file_sha256": file_sha256(tmp_path / "models" / "a.obj")}


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ('[[meshes]]\nfiles = "*"\n', r"needs a folder of meshes: name it with --objects FOLDER"),
        (MESHES + "count = 5\n", r"got 2 files, expected 5"),
        (MESHES + 'without = ["c.obj"]\n', r"`without` has c.obj, expected some of the 2 files"),
        (MESHES + '[[meshes]]\nfiles = "a*"\n', r"the same mesh in two groups: a.obj"),
        (
            MESHES.replace('"*"', '"x*"') + '[[meshes]]\nfiles = "y*"\n',
            r"'x\*' in .*got 0 files.*; meshes 'y\*' in .*got 0 files",
        ),
    ],
)
def test_what_a_folder_lacks_is_said_all_at_once(more: str, message: str, tmp_path: Path) -> None:
    write_meshes(tmp_path / "models", ["a.obj", "b.obj"])
    with pytest.raises(UnirenderError, match=message):
        suite_sources(spec_with(tmp_path, more))


@pytest.mark.parametrize(
    ("scenes", "strangers"), [("[[3, 0]]", ""), ('[["3", 0]]', "'3'"), ('[["b.obj", 0], ["a.obj", 1]]', "'b.obj'")]
)
def test_a_scene_with_a_twin_is_of_an_object_of_the_suite(scenes: str, strangers: str, tmp_path: Path) -> None:
    """A seed in quotes is the name of a mesh: no scene would get that twin."""
    write_meshes(tmp_path / "models", ["a.obj"])
    spec = spec_with(tmp_path, MESHES, objects="[3]", ceiling_scenes=scenes)
    if not strangers:
        assert [source.name for source in suite_sources(spec)] == [3, "a.obj"]
        return
    with pytest.raises(UnirenderError, match=f"ceiling_scenes has {strangers}, expected seeds"):
        suite_sources(spec)


@pytest.mark.parametrize(
    ("more", "changes", "messages"),
    [
        ("", {"resolution": '"64"', "batches": "2"}, ["resolution is '64', expected", "batches is 2, expected"]),
        ("", {"resolution": "30"}, ["resolution is 30, expected a whole number of pixels, at least 31: LPIPS-Alex"]),
        ("", {"lights_per_object": "1"}, ["lights_per_object is 1, expected at least 2"]),
        ("", {"edits": "[[1.0, 0.1]]"}, ["differ from the base in one of"]),
        ("", {"name": '"../x"'}, ["name is '../x'"]),
        ("", {"objects": "[]"}, ["it has no objects"]),
        ("[[meshes]]\ncount = 0\nfile = 1\n", {}, ["meshes[0] has unknown keys ['file']", "meshes[0].count is 0"]),
        ("[light_files]\nholdout = 1\n", {}, ["light_files.holdout is 1, expected 0 (all files) or at least 2"]),
        ("[folders]\nobject = 1\n", {}, ["unknown keys: object"]),
    ],
)
def test_every_wrong_value_is_named(more: str, changes: dict[str, str], messages: list[str], tmp_path: Path) -> None:
    with pytest.raises(UnirenderError) as error:
        spec_with(tmp_path, more, **changes)
    assert all(message in str(error.value) for message in messages), str(error.value)


def test_pictures_are_large_enough_for_every_metric() -> None:
    assert max(SMALLEST.values()) == LEAST


def test_broken_meshes_and_lights_are_named_and_nothing_is_made(tmp_path: Path) -> None:
    """All of them at once, before anything is rendered; the good one is not among them."""
    write_meshes(tmp_path / "models", ["a.obj", "b.obj"])
    (tmp_path / "models" / "a.obj").write_text("v 0 0 0\n")
    (tmp_path / "models" / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 0 1\nf 1 2 3\n")
    spec = spec_with(tmp_path, MESHES, objects="[]", ceiling_scenes="[]", resolution="32")
    reasons = list(broken_meshes(suite_sources(spec), spec))
    assert [reason.partition(":")[0] for reason in reasons] == ["a.obj", "flat.obj"]
    assert "has no faces" in reasons[0]
    assert "covers no pixel" in reasons[1]
    assert str(tmp_path) not in "".join(reasons)
    spec.path.write_text(suite_path("tiny").read_text().replace('name = "tiny"', 'name = "my"') + MESHES)
    with pytest.raises(UnirenderError, match=r"(?s)2 of its meshes cannot be used.*a\.obj.*flat\.obj"):
        next(make_truth(spec.path, tmp_path / "work"))
    assert not (tmp_path / "work").exists()
    assert not list(tmp_path.glob("*.tar"))

    write_pictures(tmp_path / "lights", 3)
    (tmp_path / "lights" / "1.png").write_bytes(b"no picture")
    (tmp_path / "lights" / "2.png").write_bytes(b"")
    folders = '[folders]\nlights = "lights"\n'
    spec.path.write_text(spec.path.read_text().replace("[folders]\n", folders) + "[light_files]\n")
    with pytest.raises(UnirenderError, match=r"(?s)2 of its meshes .*flat\.obj.*2 of its lights .*1\.png.*2\.png"):
        next(make_truth(spec.path, tmp_path / "work"))
    assert not (tmp_path / "work").exists()
    spec = spec_with(tmp_path, folders + "[light_files]\n", bundled_lights="0")
    pool = light_sources(spec)
    with pytest.raises(UnirenderError, match=r"(?s)2 of its lights cannot be read.*1\.png.*2\.png"):
        load_lights(spec, list(pool), pool)
    (good,) = (name for name in pool if name.startswith("0-"))
    light = load_lights(spec, [good], pool)[good]
    assert light.environment.shape == (64, 128, 3)
    assert light.provenance["file"] == "0.png"
    assert light.provenance["file_sha256"] == file_sha256(tmp_path / "lights" / "0.png")
    assert light.provenance["rule"].startswith("photograph")


def checked(spec: SuiteSpec) -> None:
    pool = light_sources(spec)
    check_files(spec, suite_sources(spec), load_lights(spec, list(pool), pool))


def test_links_to_folders_are_refused_and_files_of_one_thing_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """What is behind a link would be left out without a word; a copy counts as another object or light."""
    write_meshes(tmp_path / "models", ["chairs/a.obj", "chairs/b.obj", "tables/c.obj"])
    write_pictures(tmp_path / "lights", 3)
    more = '[folders]\nobjects = "models"\nlights = "lights"\n[[meshes]]\nfiles = "chairs/*"\n[light_files]\n'
    spec = spec_with(tmp_path, more, objects="[]", ceiling_scenes="[]", bundled_lights="0", procedural_lights="[]")
    (tmp_path / "models" / "tables" / "more").symlink_to(tmp_path / "models" / "chairs")
    (tmp_path / "models" / ".hidden").mkdir()
    (tmp_path / "models" / ".hidden" / "more").symlink_to(tmp_path)
    checked(spec)  # no link where files of the pattern are
    assert not caplog.messages
    trimesh.load(tmp_path / "models" / "chairs" / "b.obj").export(tmp_path / "models" / "chairs" / "b.ply")
    (tmp_path / "models" / "chairs" / "d.obj").write_bytes((tmp_path / "models" / "chairs" / "a.obj").read_bytes())
    (tmp_path / "lights" / "copy.png").write_bytes((tmp_path / "lights" / "1.png").read_bytes())
    checked(spec)
    assert [message.partition(", and count as ")[::2] for message in caplog.messages] == [
        (
            f"suite 'tiny': {names}",
            f"2 {kind}; leave all but one out (`without`)",
        )
        for names, kind in (
            ("chairs/a.obj, chairs/d.obj: have the same content", "objects"),
            ("chairs/b.obj, chairs/b.ply: look like one in several formats", "objects"),
            ("1.png, copy.png: have the same content", "lights"),
        )
    ]
    links = [tmp_path / "models" / "chairs" / "more", tmp_path / "lights" / "more"]
    for link in links:
        link.symlink_to(tmp_path / "models" / "tables")
    with pytest.raises(UnirenderError) as refused:
        checked(spec)
    assert str(refused.value).splitlines()[1:] == [f"  {link}: copy the folder, or remove the link" for link in links]


def test_a_truth_of_other_lights_is_kept(tmp_path: Path) -> None:
    """As one of other meshes is: a light's file has the name of one that the truth was made under."""
    path = write_suite(tmp_path)
    repacked(path, {**load_suite(path).provenance, "lights": {"sun": {"file": "sun.exr", "file_sha256": "a"}}})
    spec = read_spec(path)
    for name, sha256 in (("sun.exr", "a"), ("moon.exr", "b")):
        check_files(
            spec, (), {"sun": SuiteLight(np.ones((8, 16, 3), np.float32), {"file": name, "file_sha256": sha256})}
        )
    changed = SuiteLight(np.ones((8, 16, 3), np.float32), {"file": "sun.exr", "file_sha256": "b"})
    with pytest.raises(UnirenderError, match=r"ball\.tar: was made from other contents of sun\.exr; results on it"):
        check_files(spec, (), {"sun": changed})


@pytest.mark.parametrize(
    "text",
    [
        'name = "x"',
        'name = "x"\n[folders]',
        'name = "x"\n[folders]   # of files\nlights = "l"\n\n[[meshes]]\nobjects = "no"\n',
        'name = "x"\n[ folders ]\nobjects = "a\\"b"#\n',
        "name = 'x'\n[folders]\nobjects = 'C:\\old' # \"mine\"\n",
        'name = "x"\n[folders]\n  objects = "old"  # mine\nobjects_from = "there"\n[truth]\nobjects = "no"\n',
    ],
)
def test_a_folder_is_written_into_the_table_of_folders(text: str) -> None:
    import tomllib

    changed = with_folder(text, Path("x.toml"), "objects", 'C:\\a "b"')
    before, after = tomllib.loads(text), tomllib.loads(changed)
    assert after == before | {"folders": before.get("folders", {}) | {"objects": 'C:\\a "b"'}}
    assert all(line in changed for line in text.splitlines() if "objects =" not in line)
    assert [line.partition("#")[1:] for line in text.splitlines() if "#" in line] == [
        line.partition("#")[1:] for line in changed.splitlines() if "#" in line
    ], "comments stay, that on the changed line too"


@pytest.mark.parametrize(
    "text",
    [
        'folders.objects = "a"',
        'folders = { objects = "a" }',
        '[folders]\n"objects" = "a"',
        '[folders]\nobjects = """a"""',
        '["folders"]\nobjects = "a"',
        'title = """\n[folders]\n"""',
    ],
)
def test_a_folder_that_cannot_be_written_is_not_called_a_broken_file(text: str) -> None:
    """Valid TOML, written otherwise than by lines: the message says how to write it."""
    with pytest.raises(UnirenderError, match=r'x\.toml: .*write \[folders\] with `objects = "\.\.\."` on a line'):
        with_folder(text, Path("x.toml"), "objects", "b")


def mesh_suite(folder: Path) -> Suite:
    """The closed-form suite of two scenes, whose first object says that it is a file."""
    write_meshes(folder / "models", ["a.obj"])
    path = write_suite(folder)
    provenance = load_suite(path).provenance
    made = {"file": "a.obj", "file_sha256": file_sha256(folder / "models" / "a.obj"), "sha256": "none"}
    provenance["objects"]["ball-0"] = made
    text = path.read_text().replace("objects = [0, 1]", "objects = [1]").replace("[[0, 0]]", '[["a.obj", 0]]')
    path.write_text(text + MESHES)
    return repacked(path, provenance)


def repacked(path: Path, provenance: dict[str, Any]) -> Suite:
    """The closed-form suite with another `suite.json`."""
    tar, spec = path.with_name("ball.tar"), read_spec(path)
    write_tar(tar, {**list_tar(tar), "suite.json": json.dumps(provenance).encode()})
    path.write_text(path.read_text().replace(spec.truth_sha256, file_sha256(tar)))
    return load_suite(path)


def test_the_true_shape_of_a_mesh_is_read_again_or_refused(tmp_path: Path) -> None:
    suite = mesh_suite(tmp_path)
    scene, mesh = suite.scenes[0], tmp_path / "models" / "a.obj"
    obj = scene_object(suite, scene)
    assert len(obj.faces) == 12
    assert obj.name.startswith("a-")
    assert scene_object(suite, suite.scenes[-1]).family != "mesh"
    original = mesh.read_bytes()
    mesh.write_bytes(original + b"# changed\n")
    with pytest.raises(UnirenderError, match=r"a\.obj is another file than the truth was rendered from"):
        scene_object(suite, scene)
    mesh.unlink()
    with pytest.raises(UnirenderError, match=r"its mesh a\.obj is not in .*models; name the folder"):
        scene_object(suite, scene)
    unnamed = replace(suite.spec, objects_folder="")
    suite.spec = unnamed
    with pytest.raises(UnirenderError, match=r"its mesh a\.obj is not in any folder"):
        scene_object(suite, scene)


@pytest.mark.parametrize("recorded", [False, True])
def test_a_file_that_is_not_what_its_truth_was_made_from_is_refused(recorded: bool, tmp_path: Path) -> None:
    """Values that a picture, a question or a score depends on; one without a record has those that can be told."""
    path = write_suite(tmp_path)
    if recorded:
        suite = load_suite(path)
        repacked(path, {**suite.provenance, **recorded_values(suite.spec)})
    text = path.read_text()
    changes = {
        "resolution": (
            "64",
            r"resolution is 64, the truth's 32\. Put that back, or make the truth anew with `unirender",
        ),
        "edits": ("[[1.0, 0.5], [0.5, 0.1], [0.5, 0.9], [0.05, 0.5]]", r"edits is .*, the truth's \[\["),
        "per_scene": ("1", "per_scene is 1, the truth's 2"),
        "objects": ("[0]", r"objects is \[0\], the truth's \[0, 1\]"),
    }
    if recorded:
        changes |= {
            "specular_roughness": ("[0.5]", r"specular_roughness is \[0\.5\], the truth's \["),
            "fov_deg": ("40.0", "fov_deg is 40.0, the truth's 36.0"),
            "assignment_seed": ("4", "assignment_seed is 4, the truth's 3"),
        }
    for name, (value, message) in changes.items():
        path.write_text(re.sub(rf"^{name} = .*$", f"{name} = {value}", text, flags=re.MULTILINE))
        with pytest.raises(UnirenderError, match=message):
            load_suite(path)
    fewer = re.sub(r"^edits = .*$", "edits = [[1.0, 0.5], [0.5, 0.1]]", text, flags=re.MULTILINE)
    path.write_text(re.sub(r"^specular_roughness = .*$", "specular_roughness = [0.1, 0.5]", fewer, flags=re.MULTILINE))
    with pytest.raises(UnirenderError, match=r"edits is \[\[1\.0, 0\.5\], \[0\.5, 0\.1\]\], the truth's \["):
        load_suite(path)
    free = {"title": '"words"', "file": '"moved.tar"'}
    for name, value in free.items():
        text = re.sub(rf"^{name} = .*$", f"{name} = {value}", text, flags=re.MULTILINE)
    path.write_text(text)
    path.with_name("ball.tar").rename(path.with_name("moved.tar"))
    assert load_suite(path).spec.title == "words"


def test_the_truth_of_a_bundled_suite_keeps_its_bits(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """By name its file is compared with the package's: whoever renders it gets the hash that was published."""
    monkeypatch.setenv("UNIRENDER_CACHE", str(tmp_path))
    assert recorded_values(read_spec("tiny")) == {}
    assert recorded_values(target("standard")[0]) == {}
    made = recorded_values(target("standard", out=tmp_path)[0])[DEFINITION]
    assert made["edits"] == [list(edit) for edit in read_spec("standard").edits]
    assert made["meshes"][0]["holdout"] == read_spec("standard").meshes[0].holdout


def test_the_camera_of_a_truth_without_a_record_is_that_of_its_renders(tmp_path: Path) -> None:
    spec = replace(read_spec("tiny"), fov_deg=40.0)
    with pytest.raises(UnirenderError, match=r"fov_deg is 40\.0, the truth's 36\.0"):
        check_definition(Suite(spec))


def test_a_suite_without_its_truth_says_how_to_make_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One sentence with command, time and source of the files; no smaller suite in its place; once made, the name
    finds it; another version of the suite is not taken for it."""
    monkeypatch.setenv("UNIRENDER_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(suite_home, "shared", lambda name: tmp_path / "checkout" / name / f"{name}.toml")
    spec = read_spec("standard")
    with pytest.raises(UnirenderError) as error:
        load_suite("standard")
    said = str(error.value)
    assert "`unirender bench truth standard --objects FOLDER`" in said
    assert spec.truth_cost in said
    assert "apt-get download" in said
    assert any(said in line for line in listed_suites())
    assert results_check.installed_suite_hash("standard") is None

    (tmp_path / "models").mkdir()
    made, text = target("standard", objects=tmp_path / "models")
    assert made.path == home("standard")
    assert made.folder("objects") == tmp_path / "models"
    made.path.parent.mkdir(parents=True)
    made.path.write_text(text.replace('sha256 = ""', f'sha256 = "{"0" * 64}"'))
    assert found_spec("standard").path == made.path
    assert results_check.installed_suite_hash("standard") == "0" * 64
    with pytest.raises(UnirenderError, match=re.escape(f"has no truth file {made.truth_path}")):
        load_suite("standard")

    shared = suite_home.shared("standard")
    shared.parent.mkdir(parents=True)
    shared.write_text(text.replace('sha256 = ""', f'sha256 = "{"1" * 64}"'))
    assert found_spec("standard").path == made.path, "one's own comes first"
    made.path.rename(tmp_path / "standard.toml")
    assert found_spec("standard").path == shared
    made.path.write_text(text.replace("target_db = 45.0", "target_db = 30.0"))
    with pytest.raises(UnirenderError, match=r"of another version of suite 'standard'.*bench truth standard"):
        load_suite("standard")
    assert results_check.installed_suite_hash("standard") is None


def test_a_folder_beside_the_suites_file_moves_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Named from wherever the command runs; one elsewhere is written as an absolute path."""
    mine, elsewhere = tmp_path / "mine", tmp_path / "elsewhere"
    write_meshes(mine / "models", ["a.obj"])
    write_meshes(elsewhere, ["a.obj"])
    source = mine / "mine.toml"
    source.write_text(suite_path("tiny").read_text().replace('name = "tiny"', 'name = "mine"') + "\n[[meshes]]\n")
    monkeypatch.chdir(tmp_path)
    for out, given, written in (
        (None, Path("mine/models"), "models"),
        (mine, mine / "models" / ".." / "models", "models"),
        (None, Path("elsewhere"), str(elsewhere)),
        (tmp_path / "other", mine / "models", str(mine / "models")),
    ):
        spec, text = target(source, out, given)
        assert tomllib.loads(text)["folders"] == {"objects": written}
        folder = spec.folder("objects")
        assert folder is not None
        assert (folder / "a.obj").is_file()


@pytest.mark.parametrize(
    ("file", "change", "refused"),
    [
        ("paper.toml", ("", ""), False),  # as --out writes it
        ("mine.toml", ("", ""), True),
        ("paper.toml", ("resolution = 1024", "resolution = 64"), True),
        ("mine.toml", ('name = "paper"', 'name = "mine"'), False),
    ],
)
def test_another_suite_under_a_name_of_the_package_is_refused(
    tmp_path: Path, file: str, change: tuple[str, str], refused: bool
) -> None:
    path = tmp_path / file
    path.write_text(suite_path("paper").read_text().replace(*change, 1))
    for look in (found_spec, target):
        if refused:
            with pytest.raises(UnirenderError, match=rf"{file}: name is 'paper', that of a suite of the package"):
                look(path)
        else:
            look(path)


def test_folders_are_refused_where_they_are_not_used_or_not_there(tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match="suite 'tiny' takes no objects from a folder; leave --objects out"):
        target("tiny", objects=tmp_path)
    with pytest.raises(UnirenderError, match=r"--lights .*: no such folder"):
        target("paper", lights=tmp_path / "none")
    assert "--objects" not in truth_command(read_spec("tiny"))


def test_a_truth_that_changes_while_it_is_read_is_noticed(tmp_path: Path) -> None:
    suite = load_suite(write_suite(tmp_path))
    first = suite.members[0]
    suite.read(first)
    (tmp_path / "ball.tar").write_bytes((tmp_path / "ball.tar").read_bytes() + bytes(512))
    with pytest.raises(UnirenderError, match="was replaced while it was in use"):
        suite.read(first)


def test_the_command_refuses_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No folder, no such suite: 1; an option that no file makes right: 2. No traceback, nothing written."""
    monkeypatch.setenv("UNIRENDER_CACHE", str(tmp_path / "cache"))
    for words, status, said in (
        (["standard"], 1, "needs a folder of meshes: name it with --objects FOLDER"),
        (["paper", "--objects", str(tmp_path)], 1, "no mesh found"),
        (["none"], 1, "no suite 'none'"),
        (["standard", "--workers", "0"], 2, "expected at least 1"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(["bench", "truth", *words])
        error = capsys.readouterr().err
        assert stopped.value.code == status
        assert said in error
        assert "Traceback" not in error
    assert not list(tmp_path.iterdir())
