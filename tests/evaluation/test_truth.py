"""Making truth: how noise is measured, stored and brought down to a target, and the generator end to end."""

import re
import tomllib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from tiny_suites import make_suite

from unirender.errors import UnirenderError
from unirender.exr import exr_bytes, intrinsics_from_channels, read_exr_bytes
from unirender.system.whole_files import file_sha256
from unirender_evaluation.methods.ceiling import noise_ceiling, similarity_ceiling
from unirender_evaluation.scoring import score_colour, score_image
from unirender_evaluation.suites.definition import recorded
from unirender_evaluation.suites.home import target
from unirender_evaluation.suites.lights import assign_lights, light_sources, load_lights
from unirender_evaluation.suites.objects import scene_object, suite_sources
from unirender_evaluation.suites.spec import read_spec, suite_path
from unirender_evaluation.suites.suite import Suite, load_suite
from unirender_evaluation.suites.truth_file import (
    CEILING,
    PREFIX,
    Kind,
    estimate_channels,
    estimate_mean,
    estimate_variance,
)
from unirender_evaluation.truth.make import make_truth, quality_summary, with_sha256
from unirender_evaluation.truth.object import ObjectJob, object_hash, render_object
from unirender_evaluation.truth.render import render_to_ceiling, stored_ceiling_db
from unirender_reference.noise import noise_floor_db
from unirender_reference.passes import Estimate


def test_stored_noise_survives_half_floats(tmp_path: Path) -> None:
    """Radiances over four decades keep their standard deviation to a few per cent."""
    suite = make_suite(tmp_path)
    scene = suite.scenes[0]
    mean, variance = suite.image(scene, suite.spec.base), suite.image_variance(scene, suite.spec.base)
    bright = mean > 1e-3
    np.testing.assert_allclose(np.sqrt(variance[bright]) / mean[bright], 1e-3, rtol=0.06)


@pytest.mark.parametrize("kind", ["image", "specular"])
def test_sampling_goes_on_until_the_ceiling_is_reached(kind: Kind) -> None:
    """Both ceilings, the estimated and the stored one, reach the target; sampling stops there or at the limit."""
    spec = replace(read_spec("tiny"), light_target_db=44.0, light_spp=128)
    first, target = {"image": (spec.spp, spec.target_db), "specular": (128, 44.0)}[kind]
    mask, calls = np.ones((8, 8, 1), np.float32), []
    mask[:2] = 0.5
    unit = np.random.default_rng(0).uniform(0.01, 0.07, (8, 8, 3))  # variance of one sample

    def render(spp: int, seed: int) -> Estimate:
        calls.append((spp, seed))
        noise = np.random.default_rng(seed).standard_normal((8, 8, 3)) * np.sqrt(unit / spp)
        return Estimate((0.5 + noise).astype(np.float32), (unit / spp).astype(np.float32), nan_pixels=2)

    found, channels = render_to_ceiling(render, mask, spec, 7, kind)
    assert 1 < len(calls) <= 3, "the first render says how many samples are missing"
    assert first <= calls[0][0] < 1.2 * first
    assert [seed for _, seed in calls] == [7, 8, 9][: len(calls)], "every render has its own seed"
    assert found.spp == sum(count for count, _ in calls)
    assert all(count % spec.batches == 0 for count, _ in calls)
    assert found.nan_pixels == 2 * len(calls)
    np.testing.assert_allclose(found.variance, unit / found.spp, rtol=1e-4)
    assert target <= found.floor_db < target + 0.5
    assert found.floor_db == noise_floor_db(found.mean, found.variance, mask, kind == "image")
    assert target <= stored_ceiling_db(channels, mask, kind) < target + 0.7
    assert np.abs((found.mean - 0.5) / np.sqrt(unit / found.spp)).max() < 6
    short = replace(spec, max_spp=320)
    assert render_to_ceiling(render, mask, short, 7, kind)[0].floor_db < target, "max_spp ends it"


@pytest.mark.parametrize("kind", ["image", "specular", "diffuse"])
def test_members_come_back_as_they_were_written(kind: Kind) -> None:
    """Mean to half precision, std to 3 %, radiance over six decades; 0 outside the mask."""
    rng = np.random.default_rng(3)
    mask = np.array([0, 0.25, 1, 1], np.float32).reshape(2, 2, 1)
    mean = (10 ** rng.uniform(-4, 2, (2, 2, 3))).astype(np.float32)
    variance = np.square(0.01 * mean)
    channels = estimate_channels(kind, mean, variance, mask)
    assert set(channels) == {f"{PREFIX[kind]}{c}" for c in "RGB"} | {f"std.{c}" for c in "RGB"} | (
        {"A"} if kind == "image" else set()
    )
    read = read_exr_bytes(exr_bytes(channels))[0]
    inside = np.broadcast_to(mask > 0, mean.shape)
    found = estimate_mean(kind, read)
    np.testing.assert_allclose(found[inside], mean[inside], rtol=1e-3)
    np.testing.assert_allclose(np.sqrt(estimate_variance(kind, read))[inside], 0.01 * mean[inside], rtol=0.04)
    assert not found[~inside].any()
    if kind == "image":
        np.testing.assert_array_equal(read["A"], mask[..., 0])
    else:
        np.testing.assert_array_equal(getattr(intrinsics_from_channels(read), kind), found)
    assert not {"std.R", "std.G", "std.B"} & set(estimate_channels(kind, mean, None, mask))


@pytest.mark.parametrize("premultiplied", [True, False])
def test_the_ceiling_is_what_a_noise_free_prediction_scores(premultiplied: bool) -> None:
    """By Monte Carlo, for both masks and colour spaces; half of the frame is covered, a part of it by halves."""
    rng = np.random.default_rng(0)
    mask = np.repeat([1.0, 0.5, 0.0, 0.0], 16)[:, None, None].astype(np.float32) * np.ones((1, 64, 1), np.float32)
    clean = rng.uniform(0.05, 0.9, (64, 64, 3)).astype(np.float32) * (mask > 0)
    sigma = 0.004 * clean
    noisy = clean + sigma * rng.standard_normal(clean.shape, np.float32)
    scored = score_colour("relit", clean, noisy, mask, mask, ("raw",))
    scale = mask if premultiplied else 1
    found = noise_ceiling("relit", noisy * scale, np.square(sigma * scale), mask, premultiplied)
    assert found.keys() == {key for key in scored if ".psnr" in key}
    assert found == {key: pytest.approx(scored[key], abs=0.2) for key in found}
    values = sorted(found.values())
    assert min(b - a for a, b in pairwise(values)) > 0.4, "the twin: none is another one"


def test_similarity_ceiling_lies_between_a_noisy_render_and_a_perfect_score(tmp_path: Path) -> None:
    """A nearly noise-free picture scores better than another noisy one, by SSIM and by LPIPS, and below perfection."""
    suite = make_suite(tmp_path)
    scene, material = suite.scenes[0], suite.spec.base
    rng = np.random.default_rng(0)
    clean, mask = suite.image(scene, material), suite.mask(scene)
    truth, other, twin = (clean * (1 + sigma * rng.standard_normal(clean.shape)) for sigma in (0.02, 0.02, 0.005))
    found, worse = (similarity_ceiling("relit", x, truth, mask, True, ("alex",)) for x in (twin, other))
    same = score_image(twin, truth, mask, lpips=())
    assert {key.partition("@")[0] for key in found} == {"relit.ssim", "relit.lpips_alex"}
    assert all("aligned" not in key for key in found)
    for key, value in found.items():
        if ".ssim" in key:
            assert worse[key] < value < 1
            assert value == pytest.approx(same[key], rel=1e-12)
        else:
            assert worse[key] > value > 0


@pytest.mark.parametrize("line", ['sha256 = "old"', 'sha256="old"', "  sha256\t= 'old'", 'sha256 = "old"  # of "it"'])
def test_the_hash_is_written_however_the_line_is_set(line: str, tmp_path: Path) -> None:
    path = tmp_path / "suite.toml"
    path.write_text(f'[truth]\nfile = "it.tar"\n{line}\n# sha256 = "a comment"\n')
    text = with_sha256(path.read_text(), path, "new")
    assert tomllib.loads(text) == {"truth": {"file": "it.tar", "sha256": "new"}}
    assert text == path.read_text().replace("'old'", '"old"').replace("old", "new")


@pytest.mark.parametrize(("body", "count"), [('truth = { sha256 = "" }', 0), ('sha256 = ""\n[truth]\nsha256 = ""', 2)])
def test_a_suite_whose_hash_cannot_be_written_is_refused(body: str, count: int, tmp_path: Path) -> None:
    path = tmp_path / "suite.toml"
    path.write_text(body)
    with pytest.raises(UnirenderError, match=rf"suite.toml: got {count} lines like .* expected exactly one"):
        with_sha256(body, path, "new")


def test_nothing_is_rendered_for_a_suite_whose_hash_cannot_be_written(tmp_path: Path) -> None:
    path = tmp_path / "tiny.toml"
    path.write_text(suite_path("tiny").read_text().replace("\nsha256 =", '\n"sha256" ='))
    with pytest.raises(UnirenderError, match="got 0 lines"):
        next(make_truth(path, tmp_path / "work"))
    assert not (tmp_path / "work").exists()


@pytest.mark.long
def test_the_generator_makes_a_suite_resumes_and_repeats_itself(tmp_path: Path) -> None:
    """One object at 32 px: what the suite file asks for is there; finished parts are kept; another work folder gives
    the same bytes; another suite file does not reuse parts."""
    text = suite_path("tiny").read_text()
    changes = {
        "name": '"mini"',
        "resolution": "32",
        "objects": "[1]",
        "per_scene": "1",
        "light_rows": "8",
        "bundled_lights": "1",
        "procedural_lights": "[0, 2]",
        "file": '"mini.tar"',
        "spp": "64",
        "light_spp": "64",
        "target_db": "33.0",
        "light_target_db": "35.0",
        "ceiling_factor": "4",
        "ceiling_scenes": "[[1, 1]]",
    }
    for name, value in changes.items():
        text = re.sub(rf"^{name} = .*$", f"{name} = {value}", text, flags=re.MULTILINE)
    path = tmp_path / "mini.toml"
    path.write_text(text)
    assert list(make_truth(path, tmp_path / "work", workers=10**12)) == [(1, 1)]
    suite, first = load_suite(path), (tmp_path / "mini.tar").read_bytes()
    assert recorded(suite.spec).items() <= suite.provenance.items()
    kinds = quality_summary(suite)
    assert {kind: row["n"] for kind, row in kinds.items()} == {"image": 10, "specular": 6, "diffuse": 2}
    assert kinds["image"]["min_db"] >= 33
    assert min(kinds[kind]["min_db"] for kind in ("specular", "diffuse")) >= 35
    assert sum(name.startswith(CEILING) for name in suite.members) == 6
    assert len({scene.light for scene in suite.scenes}) == sum(name.startswith("light_") for name in suite.members) == 2
    _, attributes = suite.read(f"{suite.scenes[1].key}.m050_r050.exr")
    _, twin = suite.read(f"{CEILING}{suite.scenes[1].key}.m050_r050.exr")
    assert int(twin["spp"]) >= 4 * int(attributes["spp"])
    assert twin["seed"] != attributes["seed"]

    (part,) = (tmp_path / "work").glob("*/*.tar")
    made = part.stat().st_mtime_ns
    list(make_truth(path, tmp_path / "work", workers=1))
    assert part.stat().st_mtime_ns == made, "a finished part is not rendered again"
    list(make_truth(path, tmp_path / "elsewhere", workers=1))
    assert (tmp_path / "mini.tar").read_bytes() == first, "equal seeds give equal bytes"
    path.write_text(text.replace("assignment_seed = 3", "assignment_seed = 4"))
    list(make_truth(path, tmp_path / "work", workers=1))
    assert len(list((tmp_path / "work").glob("*/*.tar"))) == 2
    assert (tmp_path / "mini.tar").read_bytes() != first


MESHES_ALONE = {
    "name": '"mine"',
    "objects": "[]",
    "ceiling_scenes": "[]",
    "bundled_lights": "2",
    "procedural_lights": "[0]",
    "resolution": "32",
    "light_rows": "8",
    "per_scene": "1",
    "spp": "8",
    "light_spp": "8",
    "max_spp": "64",
    "geometry_spp": "64",
    "target_db": "10.0",
    "light_target_db": "10.0",
    "sha256": '""',
    "file": '"mine.tar"',
}
TETRAHEDRON = "v -1 -1 -1\nv 1 -1 -1\nv 0 1 -1\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def write_mesh_suite(folder: Path, names: str) -> Path:
    """A suite of small pictures of equal meshes, without its truth."""
    (folder / "meshes").mkdir()
    for name in names:
        (folder / "meshes" / f"{name}.obj").write_text(TETRAHEDRON)
    text = suite_path("tiny").read_text()
    for name, value in MESHES_ALONE.items():
        text = re.sub(rf"^{name} = .*$", f"{name} = {value}", text, flags=re.MULTILINE)
    path = folder / "mine.toml"
    path.write_text(text + '\n[folders]\nobjects = "meshes"\n\n[[meshes]]\n')
    return path


@pytest.mark.long
def test_a_part_is_kept_for_the_same_file_lights_turns_and_materials_alone(tmp_path: Path) -> None:
    spec, _ = target(write_mesh_suite(tmp_path, "a"))
    (source,), pool = suite_sources(spec), light_sources(spec)
    lights = {name: light.environment for name, light in load_lights(spec, list(pool), pool).items()}
    a, b, c = lights
    materials = (((0.1, 0.2),), ((0.3, 0.4),))
    (tmp_path / "work").mkdir()
    job = ObjectJob(spec, source, ((a, 1), (b, 2)), lights, materials, tmp_path / "work")
    first = render_object(job)
    made = first.stat().st_mtime_ns
    assert render_object(job) == first
    assert first.stat().st_mtime_ns == made
    others = [
        render_object(replace(job, lights=((a, 1), (c, 2)))),
        render_object(replace(job, lights=((a, 1), (b, 3)))),
        render_object(replace(job, materials=materials[::-1])),
    ]
    (tmp_path / "meshes" / "a.obj").write_text(TETRAHEDRON + "# a comment\n")
    others.append(render_object(job))
    assert len({first, *others}) == 5
    assert all(path.is_file() for path in others)


@pytest.mark.long
def test_a_truth_follows_the_files_that_are_in_the_folder(tmp_path: Path) -> None:
    """A mesh is deleted and another gets a comment: same suite file, same lights, same shapes; but lights, turns and
    materials are dealt out anew, and the file is another."""
    path, work = write_mesh_suite(tmp_path, "abc"), tmp_path / "work"
    assert len(list(make_truth(path, work))) == 3
    (tmp_path / "meshes" / "a.obj").unlink()
    (tmp_path / "meshes" / "c.obj").write_text(TETRAHEDRON + "# a comment\n")
    truth = load_suite(path).spec.truth_path
    before = truth.read_bytes()
    with pytest.raises(UnirenderError, match=r"was made from other contents of c\.obj.*another --out, or remove it"):
        list(make_truth(path, work))
    assert truth.read_bytes() == before
    truth.unlink()
    assert len(list(make_truth(path, work))) == 2
    assert len(list(work.iterdir())) == 1, "the folder of the parts is the same: their names have to differ"
    suite = load_suite(path)
    assigned = assign_lights(suite.spec, list(light_sources(suite.spec)), 2)
    assert [(scene.light, scene.turn_columns) for scene in suite.scenes] == assigned
    assert [list(scene.materials) for scene in suite.scenes] == suite.spec.materials(2)
    for scene in suite.scenes:
        assert object_hash(scene_object(suite, scene)) == suite.provenance["objects"][scene.object]["sha256"]


@pytest.mark.long
def test_the_papers_protocol_runs_on_a_folder_of_meshes_and_pictures(tmp_path: Path) -> None:
    """Two GLB files and two PNG at 32 px: the truth names what it was made of, its hash follows the files' content, and
    rows that are told the shape read it again."""
    models, lights = tmp_path / "models", tmp_path / "lights"
    models.mkdir()
    lights.mkdir()
    trimesh.creation.icosphere(1).export(models / "ball.glb")
    trimesh.creation.box((1, 1, 0.5)).export(models / "box.glb")
    rng = np.random.default_rng(0)
    for name in ("dawn", "dusk"):
        Image.fromarray(rng.integers(0, 256, (16, 24, 3), np.uint8)).save(lights / f"{name}.png")
    text = suite_path("paper").read_text()
    changes = {
        "name": '"small"',
        "resolution": "32",
        "light_rows": "8",
        "per_scene": "1",
        "spp": "32",
        "light_spp": "32",
        "target_db": "28.0",
        "light_target_db": "28.0",
    }
    for name, value in changes.items():
        text = re.sub(rf"^{name} = .*$", f"{name} = {value}", text, flags=re.MULTILINE)
    (tmp_path / "small.toml").write_text(text)

    def make(out: str) -> Suite:
        folders = {"objects": models, "lights": lights, "out": tmp_path / out}
        assert len(list(make_truth(tmp_path / "small.toml", tmp_path / "work", 2, **folders))) == 2
        return load_suite(tmp_path / out / "small.toml")

    suite = make("first")
    assert (tmp_path / "small.toml").read_text() == text, "the suite that is copied stays as it is"
    assert suite.spec.folder("objects") == models
    made = suite.provenance["objects"]
    assert [row["file"] for row in made.values()] == ["ball.glb", "box.glb"]
    assert [row["file_sha256"] for row in made.values()] == [file_sha256(models / n) for n in ("ball.glb", "box.glb")]
    assert sorted(row["file"] for row in suite.provenance["lights"].values()) == ["dawn.png", "dusk.png"]
    assert str(tmp_path) not in suite._member("suite.json").decode()
    assert [scene.family for scene in suite.scenes] == ["mesh"] * 4
    assert all(len({s.light for s in pair}) == 2 for pair in (suite.scenes[:2], suite.scenes[2:]))
    for scene in suite.scenes:
        maps = suite.intrinsics(scene, suite.spec.base).require("albedo", "specular", "diffuse")
        assert 0.1 < suite.mask(scene).mean() < 0.9
        assert all(maps[name].max() > 0.01 for name in maps)
        assert object_hash(scene_object(suite, scene)) == made[scene.object]["sha256"]
    assert quality_summary(suite)["image"]["min_db"] >= 28

    assert make("again").sha256 == suite.sha256, "equal files give equal bytes"
    (part,) = (tmp_path / "work").glob("*/ball-*.tar")
    before = part.stat().st_mtime_ns
    trimesh.creation.box((1, 1, 0.6)).export(models / "box.glb")
    assert make("other").sha256 != suite.sha256
    assert part.stat().st_mtime_ns == before, "what did not change is not rendered again"
    with pytest.raises(UnirenderError, match=r"box\.glb is another file than the truth was rendered from"):
        scene_object(suite, suite.scenes[2])
