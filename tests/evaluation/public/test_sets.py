"""Readers of public test sets, on tiny folders in their authors' layouts: what they hand out, and broken folders."""

import ast
import json
import shutil
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from icc_profiles import SRGB_D50, matrix_profile
from PIL import Image
from public_folders import ALBEDO, LIGHT, POSE, make_iiw, make_maw, make_orb, turned

from unirender.color import srgb_decode, srgb_encode
from unirender.errors import UnirenderError
from unirender.exr import image_channels, write_exr
from unirender.intrinsics import Intrinsics
from unirender.light.environment import environment_directions, sample_environment
from unirender_evaluation.metrics import Variant, metric_key
from unirender_evaluation.public.files import PublicSetError, block_mean, read_array, shrunk
from unirender_evaluation.public.iiw import Iiw
from unirender_evaluation.public.maw import Maw, adobe_to_rec709, measured
from unirender_evaluation.public.metrics import COSINE_DISTANCE, PSNR_H, PSNR_L
from unirender_evaluation.public.orb import StanfordOrb
from unirender_evaluation.public.orb_files import contract_environment
from unirender_evaluation.public.orb_frames import Capture, Photograph, captures, difference_deg, object_of
from unirender_evaluation.public.sets import Answer, PublicSet
from unirender_evaluation.versions import package_folder


@pytest.fixture
def orb(tmp_path: Path) -> StanfordOrb:
    return StanfordOrb(make_orb(tmp_path / "orb"), 32)


def sample_of(public: PublicSet, key: str):
    (found,) = (sample for sample in public.samples() if sample.key == key)
    return found


def problems(public: PublicSet) -> str:
    with pytest.raises(PublicSetError) as caught:
        public.samples()
    return "\n".join(caught.value.problems)


def test_orb_hands_out_the_photograph_its_mask_and_camera(orb: StanfordOrb) -> None:
    found = orb.inputs(sample_of(orb, "cup_scene002_0000"))
    assert found["image_srgb"].shape == (32, 32, 3)
    assert np.isin(np.round(found["image_srgb"] * 255, 3), np.arange(256)).all()
    assert found["camera"].fov_deg == pytest.approx(np.degrees(0.6))  # square: vertical is horizontal
    assert 0.3 < found["mask"].mean() < 0.45  # a disc of radius 0.7
    assert (found["image_srgb"][found["mask"][..., 0] == 0] == 0).all()


def test_orb_knows_the_truth_from_a_wrong_answer(orb: StanfordOrb) -> None:
    sample = sample_of(orb, "cup_scene001_0000")
    normal = np.load(sample.files[3]) if sample.files[3].parent.name == "surface_normal" else None
    assert normal is not None
    small = block_mean(normal, 32, "normal")
    albedo = np.broadcast_to(ALBEDO, (32, 32, 3)).copy()
    mask = orb.inputs(sample)["mask"]
    unit = np.divide(small, np.linalg.norm(small, axis=-1, keepdims=True), out=0 * small, where=mask > 0)
    right = orb.score(sample, Answer(Intrinsics(albedo=albedo, normal=unit, mask=mask)), ())
    opencv = unit * np.array([1, -1, -1], np.float32)
    wrong = orb.score(sample, Answer(Intrinsics(albedo=albedo[..., ::-1], normal=opencv, mask=mask)), ())
    cosine, raw = metric_key("normal", COSINE_DISTANCE), metric_key("albedo", PSNR_L, Variant(scale="raw"))
    assert right[cosine] < 1e-4 < 1 < wrong[cosine]
    assert wrong[raw] < 25 < 45 < right[raw]  # the stored albedo has 8 bits
    scaled = metric_key("albedo", PSNR_L, Variant(scale="aligned_rgb"))
    assert wrong[scaled] > 60  # a factor per channel forgives every colour of an even albedo


def test_orb_relights_only_from_the_same_camera(orb: StanfordOrb) -> None:
    same, beside = "cup_scene001/relight_cup_scene002_0000", "cup_scene001/relight_cup_scene002_0001"
    relit = {sample.key: sample.one_picture for sample in orb.samples() if sample.asks == "relight"}
    assert relit == {same: True, beside: False}
    wide = StanfordOrb(orb.folder, 32, tolerance_deg=45)
    assert all(sample.one_picture for sample in wide.samples())
    asked = dict(wide.protocol("stanford-orb-relighting"))["asked"]
    assert asked.startswith("the object in another place, 2 photographs")
    assert "only the 2 from within 45 degrees" in asked
    assert "asked" not in dict(wide.protocol("stanford-orb"))
    with pytest.raises(UnirenderError, match="no photograph was taken"):
        orb.inputs(sample_of(orb, beside))
    found = orb.inputs(sample_of(orb, same))
    assert found["environment"].shape == (16, 32, 3)
    assert found["environment"][3, 7] == pytest.approx(LIGHT["cup_scene002"])
    ldr, light = orb.folder / "blender_LDR/cup_scene001", orb.folder / "ground_truth/cup_scene002/env_map/0000.exr"
    handed_out = {light, *(ldr / kind / "0000.png" for kind in ("test", "test_mask"))}
    assert handed_out <= set(sample_of(orb, same).files), "with other ones a record is another"


def test_orb_scores_a_relit_picture_against_the_linear_photograph(orb: StanfordOrb) -> None:
    same = sample_of(orb, "cup_scene001/relight_cup_scene002_0000")
    other = sample_of(orb, "cup_scene002_0000")
    found = orb.inputs(other)
    seen = srgb_decode(found["image_srgb"]) * found["mask"]
    unedited = orb.inputs(same)
    before = srgb_decode(unedited["image_srgb"]) * unedited["mask"]
    high, scaled = (metric_key("relit", PSNR_H, Variant(scale=scale)) for scale in ("raw", "aligned_rgb"))
    right, wrong = (orb.score(same, Answer(image=x), ()) for x in (seen, before))
    assert right[high] > 40 > 30 > wrong[high]
    assert wrong[scaled] > 40  # the lights differ in colour alone
    floor = orb.score(same, Answer(image=np.zeros((32, 32, 3), np.float32)), ())
    assert floor[high.replace("psnr_h", "psnr_h_floored")] == 1
    assert right[high.replace("psnr_h", "psnr_h_floored")] == 0
    assert floor[metric_key("relit", PSNR_L, Variant(scale="aligned_rgb"))] < 40, "black is what is fitted"


def test_orb_s_light_is_turned_to_the_contract_s_grid() -> None:
    """In an env_map the middle looks along -z; a quarter to the right is +x; the top row is +y."""
    stored = np.zeros((17, 65, 3), np.float32)
    stored[8, 32] = (1, 0, 0)  # -z
    stored[8, 48] = (0, 1, 0)  # +x
    stored[0] = (0, 0, 1)
    directions = np.array([[0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0]], np.float32)
    found = sample_environment(contract_environment(stored), directions)
    assert min(found[0, 0], found[1, 1]) > 0.4
    assert found[3, 2] == 1
    assert max(found[2].max(), found[0, 1], found[1, 0]) < 1e-6
    smooth = np.linspace(0, 1, 64)  # of the azimuth, from +z over -x, -z and +x back to +z
    ramp = np.broadcast_to(smooth[:, None], (17, 64, 3)).astype(np.float32)
    turned_ramp, way = contract_environment(ramp), environment_directions(17, 64)
    azimuth = np.arctan2(way[8, :, 0], -way[8, :, 2]) / (2 * np.pi) + 0.5
    assert turned_ramp[8, :, 0] == pytest.approx(azimuth, abs=1e-5)


def test_cameras_differ_by_turn_place_and_field_of_view() -> None:
    def frame(pose: np.ndarray, angle: float = 0.6) -> Photograph:
        return Photograph("a", "test", "0", angle, tuple(map(tuple, pose.tolist())))

    moved = POSE.copy()
    moved[0, 3] = 3 * np.tan(np.radians(5))
    for degrees in range(0, 360, 7):  # of some the trace is above 3, by rounding
        assert difference_deg(frame(turned(degrees)), frame(turned(degrees))) == pytest.approx(0, abs=1e-5)
    assert difference_deg(frame(POSE), frame(turned(10))) == pytest.approx(10, abs=0.1)
    assert difference_deg(frame(POSE), frame(moved)) == pytest.approx(5)
    assert difference_deg(frame(POSE), frame(POSE, 0.6 + np.radians(3))) == pytest.approx(3)
    capture = Capture("a", "cup", (frame(turned(3)), frame(turned(1))), (frame(turned(-2)),), (), ())
    nearest = capture.nearest(frame(POSE), 5)
    assert nearest is not None
    np.testing.assert_array_equal(nearest.matrix, turned(1))
    assert capture.nearest(frame(POSE), 0.9) is None
    assert object_of("teapot_scene001") == "teapot"
    assert object_of("scene001_obj018_teapot") == "obj018_teapot"


def test_orb_without_hdr_asks_for_maps_alone(tmp_path: Path) -> None:
    folder = make_orb(tmp_path)
    shutil.rmtree(folder / "blender_HDR")
    shutil.rmtree(folder / "ground_truth" / "cup_scene001")
    assert [sample.key for sample in StanfordOrb(folder, 32).samples()] == ["cup_scene002_0000", "cup_scene002_0001"]
    shutil.rmtree(folder / "ground_truth" / "cup_scene002")
    assert "has nothing to compare with" in problems(StanfordOrb(folder, 32))


def test_orb_names_every_file_that_is_not_as_it_should_be(tmp_path: Path) -> None:
    folder = make_orb(tmp_path / "orb")
    (folder / "blender_LDR/cup_scene002/test_mask/0000.png").unlink()
    (folder / "ground_truth/cup_scene001/surface_normal/0000.npy").unlink()
    said = problems(StanfordOrb(folder, 32))
    assert "test_mask/0000.png: no such file" in said
    assert "surface_normal/0000.npy: no such file" in said
    (folder / "blender_LDR/cup_scene001/transforms_test.json").write_text('{"frames": [{"file_path": "test/0000"}]}')
    (folder / "blender_LDR/cup_scene002/transforms_test.json").write_text("{")
    said = problems(StanfordOrb(folder, 32))
    assert "'transform_matrix' is missing" in said
    assert "cup_scene002/transforms_test.json: not readable" in said
    novel = folder / "blender_LDR/cup_scene001/transforms_novel.json"
    novel.write_text(novel.read_text().replace("0.6", "34.4"))  # degrees
    assert f"{novel}: not readable (camera_angle_x 34.4)" in problems(StanfordOrb(folder, 32))
    assert "no such folder" in problems(StanfordOrb(tmp_path / "nowhere", 32))


def test_orb_refuses_broken_files_and_sizes(orb: StanfordOrb) -> None:
    sample = sample_of(orb, "cup_scene001_0000")
    with pytest.raises(UnirenderError, match="is 64 x 64 pixels, expected a multiple of 48 columns; pass --resolution"):
        StanfordOrb(orb.folder, 48).inputs(sample)
    light = orb.folder / "ground_truth/cup_scene002/env_map/0000.exr"
    write_exr(light, {"Y": np.ones((4, 8), np.float32)})
    with pytest.raises(UnirenderError, match=r"0000\.exr: EXR channels R, G, B missing"):
        orb.inputs(sample_of(orb, "cup_scene001/relight_cup_scene002_0000"))
    radiance = np.ones((4, 8, 3), np.float32)
    radiance[1, 2:5, 0] = np.nan
    OpenEXR.File({}, {"RGB": radiance}).write(str(light))
    with pytest.raises(UnirenderError, match=r"0000\.exr: 3 pixels are NaN or infinite"):
        orb.inputs(sample_of(orb, "cup_scene001/relight_cup_scene002_0000"))
    np.save(orb.folder / "ground_truth/cup_scene001/surface_normal/0000.npy", np.full((64, 64, 3), np.nan))
    with pytest.raises(UnirenderError, match="NaN or infinite"):
        orb.score(sample, Answer(), ())


@pytest.mark.parametrize("width", [32, 64])
@pytest.mark.parametrize(
    ("kind", "stored", "message"),
    [
        ("pseudo_gt_albedo", lambda n: np.full(n.shape, 200, np.uint8), r"got integers \(uint8\) of \(64, 64, 3\)"),
        ("pseudo_gt_albedo", lambda n: np.full(n.shape, 200.0), "the albedo reaches from 200 to 200 on the object"),
        ("pseudo_gt_albedo", lambda n: np.full(n.shape, -0.1), "the albedo reaches from -0.1 to -0.1"),
        ("surface_normal", lambda n: (n + 1) / 2, r"% of the object's normals have another length than 1"),
        ("surface_normal", lambda n: 0 * n, "100% of the object's normals"),
        ("surface_normal", lambda n: np.round(127 * n).astype(np.int8), r"got integers \(int8\)"),
        ("z_depth", lambda n: np.full(n.shape[:2], 3000, np.uint16), r"got integers \(uint16\)"),
    ],
)
def test_orb_refuses_a_truth_in_another_unit(
    orb: StanfordOrb, width: int, kind: str, stored: Callable[[np.ndarray], np.ndarray], message: str
) -> None:
    truth = orb.folder / "ground_truth/cup_scene001"
    normal = np.load(truth / "surface_normal/0000.npy")
    (truth / "pseudo_gt_albedo/0000.png").unlink()
    np.save(truth / "pseudo_gt_albedo/0000.npy", np.full((64, 64, 3), 0.5))
    reader = StanfordOrb(orb.folder, width)
    reader.score(sample_of(reader, "cup_scene001_0000"), Answer(), ())  # the twin
    np.save(truth / kind / "0000.npy", stored(normal))
    with pytest.raises(UnirenderError, match=rf"{kind}/0000\.npy: .*{message}"):
        reader.score(sample_of(reader, "cup_scene001_0000"), Answer(), ())


def test_orb_looks_at_a_truth_where_it_counts(orb: StanfordOrb) -> None:
    """Whatever lies outside the mask, and a few holes of the scan."""
    truth = orb.folder / "ground_truth/cup_scene001"
    albedo, normal = np.full((64, 64, 3), 0.5), np.load(truth / "surface_normal/0000.npy")
    albedo[0], normal[0], normal[30:34, 30:34] = 7, 5, 0
    albedo[32, 30], albedo[32, 31] = 0, 1  # as black and white as a surface may be
    (truth / "pseudo_gt_albedo/0000.png").unlink()
    np.save(truth / "pseudo_gt_albedo/0000.npy", albedo)
    np.save(truth / "surface_normal/0000.npy", normal)
    orb.score(sample_of(orb, "cup_scene001_0000"), Answer(), ())


def test_orb_refuses_maps_of_another_shape_than_the_mask(orb: StanfordOrb) -> None:
    truth, linear = (
        orb.folder / "ground_truth/cup_scene001/surface_normal/0000.npy",
        orb.folder / "blender_HDR/cup_scene002/test/0000.exr",
    )
    np.save(truth, np.load(truth)[:32])
    relit = sample_of(orb, "cup_scene001/relight_cup_scene002_0000")
    write_exr(linear, image_channels(np.ones((32, 64, 3), np.float32)))
    image = np.zeros((32, 32, 3), np.float32)
    for sample, path, capture in (
        (sample_of(orb, "cup_scene001_0000"), truth, "cup_scene001"),
        (relit, linear, "cup_scene002"),
    ):
        with pytest.raises(UnirenderError) as caught:
            orb.score(sample, Answer(image=image), ())
        mask = orb.folder / f"blender_LDR/{capture}/test_mask/0000.png"
        assert str(caught.value) == f"{path}: is 64 x 32 pixels, expected a square like its mask {mask}"


def test_orb_refuses_rectangles(orb: StanfordOrb) -> None:
    photo, mask = (orb.folder / f"blender_LDR/cup_scene001/{name}/0000.png" for name in ("test", "test_mask"))
    Image.open(photo).crop((0, 16, 64, 48)).save(photo)
    sample = sample_of(orb, "cup_scene001_0000")
    with pytest.raises(UnirenderError) as caught:
        orb.inputs(sample)
    assert str(caught.value) == f"{mask}: is 64 x 64 pixels, expected 64 x 32 as its photograph {photo}"
    Image.open(mask).crop((0, 16, 64, 48)).save(mask)
    for ask in (lambda: orb.inputs(sample), lambda: orb.score(sample, Answer(), ())):
        with pytest.raises(UnirenderError, match=r"test_mask/0000\.png: is 64 x 32 pixels, expected a square, as all"):
            ask()


def test_orb_takes_the_scale_out_of_a_pose(tmp_path: Path) -> None:
    folder = make_orb(tmp_path)
    path = folder / "blender_LDR/cup_scene001/transforms_novel.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        pose = np.array(frame["transform_matrix"])
        frame["transform_matrix"] = (pose @ np.diag([2, 2, 2, 1])).tolist()
    (plain,) = {capture.novel for capture in captures(folder)[0] if capture.name == "cup_scene001"}
    path.write_text(json.dumps(content))
    (scaled,) = {capture.novel for capture in captures(folder)[0] if capture.name == "cup_scene001"}
    for one, other in zip(plain, scaled, strict=True):
        np.testing.assert_allclose(one.pose, other.pose, rtol=0, atol=1e-12)


@pytest.mark.parametrize("factors", [(2, 2, 1), (1, 1, 1.01), (-1, 1, 1)])
def test_orb_refuses_a_pose_with_mirroring_or_shear(tmp_path: Path, factors: tuple[float, float, float]) -> None:
    folder = make_orb(tmp_path)
    path = folder / "blender_LDR/cup_scene001/transforms_novel.json"
    content = json.loads(path.read_text())
    content["frames"][1]["transform_matrix"] = (turned(40) @ np.diag([*factors, 1])).tolist()
    path.write_text(json.dumps(content))
    said = problems(StanfordOrb(folder, 32))
    assert f"{path}: frame test/0001: the transform_matrix is no rotation, position and scale" in said


def test_files_nested_too_deep_are_named(tmp_path: Path) -> None:
    orb, iiw = make_orb(tmp_path / "orb"), make_iiw(tmp_path / "iiw")
    for path, public in (
        (orb / "blender_LDR/cup_scene001/transforms_test.json", StanfordOrb(orb, 32)),
        (iiw / "data/100.json", Iiw(iiw)),
    ):
        path.write_text("[" * 100_000)
        assert f"{path}: not readable" in problems(public)


def test_iiw_refuses_values_out_of_range_before_a_run(tmp_path: Path) -> None:
    folder = make_iiw(tmp_path)
    for name, old, new in (
        ("100", '"x": 0.25', '"x": 12.5'),
        ("101", '"darker_score": 2.0', '"darker_score": Infinity'),
        ("102", '"opaque": true', '"opaque": "false"'),
    ):
        path = folder / "data" / f"{name}.json"
        text = path.read_text()
        assert old in text or name == "102"
        path.write_text(text.replace(old, new, 1))
    said = problems(Iiw(folder))
    assert "100.json: intrinsic_points, id 1: x is 12.5, expected a fraction of the width, 0 to 1" in said
    assert "101.json: intrinsic_comparisons[0]: darker_score is inf, expected a finite number" in said
    assert "102.json: intrinsic_points, id 1: opaque is 'false', expected true, false or null" in said


def test_iiw_judges_an_albedo_of_any_size(tmp_path: Path) -> None:
    iiw = Iiw(make_iiw(tmp_path))
    assert [sample.key for sample in iiw.samples()] == ["100", "101"]
    assert dict(iiw.protocol("iiw"))["photographs without a judgement that counts"] == "1"
    sample = iiw.samples()[0]
    assert iiw.inputs(sample)["image_srgb"].shape == (20, 30, 3)
    assert iiw.frame(sample)[0] == (20, 30)
    small = Iiw(tmp_path, 15).inputs(sample)
    assert small["image_srgb"].shape == (10, 15, 3)
    assert small["mask"].all()
    albedo = np.full((6, 8, 3), 0.2, np.float32)
    albedo[:, 4:] = 0.6
    key = "albedo.whdr"
    assert iiw.score(sample, Answer(Intrinsics(albedo=albedo)), ())[key] == 0
    assert iiw.score(sample, Answer(Intrinsics(albedo=albedo[:, ::-1])), ())[key] == pytest.approx(2 / 3)
    assert iiw.score(sample, Answer(), ()) == {}
    content = json.loads(sample.files[1].read_text())
    content["intrinsic_comparisons"][0]["darker"] = "2"  # a swapped judgement
    before = sample.sha256()
    sample.files[1].write_text(json.dumps(content))
    assert sample.sha256() != before
    assert iiw.score(sample, Answer(Intrinsics(albedo=albedo)), ())[key] == pytest.approx(2 / 3)


def test_iiw_names_what_is_wrong(tmp_path: Path) -> None:
    folder = make_iiw(tmp_path / "iiw")
    (folder / "data" / "100.png").unlink()
    (folder / "data" / "101.json").write_text('{"intrinsic_points": []}')
    (folder / "data" / "102.json").write_text("no")
    said = problems(Iiw(folder))
    assert "100.png: no such file, expected the photograph of its .json" in said
    assert "101.json: 'intrinsic_comparisons' is missing, expected IIW's" in said
    assert "102.json: not readable" in said
    (tmp_path / "empty").mkdir()
    assert "has no .json file" in problems(Iiw(tmp_path / "empty"))
    assert "nowhere: no such folder" in problems(Iiw(tmp_path / "nowhere"))


def test_maw_compares_measured_surfaces(tmp_path: Path) -> None:
    maw = Maw(make_maw(tmp_path))
    (sample,) = maw.samples()
    assert (sample.key, sample.object) == ("scene_0_DSC1", "scene_0")
    albedo = np.full((120, 160, 3), 0.5, np.float32)
    albedo[:, :50], albedo[:, 110:] = 0.1, 0.3  # half as bright as measured: a factor undoes it
    right = maw.score(sample, Answer(Intrinsics(albedo=albedo)), ())
    swapped = maw.score(sample, Answer(Intrinsics(albedo=albedo[:, ::-1])), ())
    assert right["albedo.intensity"] == pytest.approx(0, abs=2e-3)  # 8 bits
    assert right["albedo.chromaticity"] == pytest.approx(0, abs=0.05)
    # swapped: p = (.3, .1), t = (.2, .6), equal weights: a = .12 / .1 = 1.2; errors .16^2, .48^2
    assert swapped["albedo.intensity"] == pytest.approx(100 * (0.16**2 + 0.48**2) / 2, rel=0.02)
    red = maw.score(sample, Answer(Intrinsics(albedo=albedo * np.array([1.6, 0.7, 0.7], np.float32))), ())
    assert red["albedo.intensity"] == pytest.approx(0, abs=5e-3)
    assert red["albedo.chromaticity"] > 10


def test_maw_colours_are_adobe_rgb() -> None:
    assert adobe_to_rec709() @ np.ones(3) == pytest.approx(np.ones(3), abs=2e-4)  # both whites are D65
    assert adobe_to_rec709()[0] == pytest.approx([1.398, -0.398, 0], abs=1e-3)


@pytest.mark.parametrize("value", [-0.01, 2.5, 200.0])
def test_maw_refuses_colours_out_of_range(tmp_path: Path, value: float) -> None:
    folder = make_maw(tmp_path)
    path = folder / "labels/colors/DSC1.npy"
    np.save(path, np.array([[0.2] * 3, [0.6, 0.6, value]]))
    assert f"{path}: has values from" in problems(Maw(folder))
    np.save(path, np.array([[-1e-4, 0.2, 0.2], [0.6, 0.6, 1.05]]))  # of rounding, and of noise
    assert len(Maw(folder).samples()) == 1
    np.save(path, np.array([[0, 1, 0], [0.6, 0.6, 1]]))  # outside Rec.709, and clipped
    assert measured(path, path.with_name("DSC1_mask.png"))[0][0] == pytest.approx([0, 1, 0], abs=2e-4)


def test_an_array_with_a_damaged_header_is_told(tmp_path: Path) -> None:
    """NumPy raises a `TokenError` here."""
    folder = make_maw(tmp_path)
    path = folder / "labels/colors/DSC1.npy"
    path.write_bytes(path.read_bytes().replace(b"{", b"(", 1))
    assert f"{path}: not a readable NumPy array" in problems(Maw(folder))
    with pytest.raises(UnirenderError, match=r"DSC1\.npy: not a readable NumPy array .*; copy it again"):
        read_array(path, 3)


def test_a_photograph_of_another_colour_space_is_seen_in_srgb(tmp_path: Path) -> None:
    folder = make_iiw(tmp_path)
    public = Iiw(folder)
    sample = public.samples()[0]
    photo, before = Image.open(sample.files[0]), public.inputs(sample)["image_srgb"]
    photo.save(sample.files[0], icc_profile=matrix_profile(SRGB_D50, 1.0))
    seen, expected = public.inputs(sample)["image_srgb"], srgb_encode(before)
    np.testing.assert_allclose(seen, expected, rtol=0, atol=2 / 255)
    assert np.abs(seen - before).max() > 0.1


def test_orb_normals_of_a_rough_scan_are_right_at_any_resolution(tmp_path: Path) -> None:
    """Means of unit vectors are shorter; what is stored has length 1."""
    folder = make_orb(tmp_path)
    path = folder / "ground_truth/cup_scene001/surface_normal/0000.npy"
    rough = np.load(path) + np.random.default_rng(0).normal(0, 0.8, np.load(path).shape)
    np.save(path, rough / np.linalg.norm(rough, axis=-1, keepdims=True))
    for resolution in (64, 32, 16):
        orb = StanfordOrb(folder, resolution)
        assert (
            orb.score(
                sample_of(orb, "cup_scene001_0000"),
                Answer(maps=Intrinsics(mask=np.ones((resolution, resolution, 1)))),
                (),
            )
            is not None
        )
    np.save(path, (rough / np.linalg.norm(rough, axis=-1, keepdims=True) + 1) / 2)
    with pytest.raises(UnirenderError, match="of the object's normals have another length than 1"):
        orb.score(sample_of(orb, "cup_scene001_0000"), Answer(), ())


def test_maw_reads_a_list_with_a_byte_order_mark(tmp_path: Path) -> None:
    folder = make_maw(tmp_path)
    meta = folder / "labels/meta.csv"
    meta.write_text(meta.read_text(), encoding="utf-8-sig")
    assert [sample.key for sample in Maw(folder).samples()] == ["scene_0_DSC1"]


def test_maw_names_what_is_wrong(tmp_path: Path) -> None:
    folder = make_maw(tmp_path / "maw")
    meta = folder / "labels" / "meta.csv"
    line = meta.read_text()
    meta.write_text(line + line.replace("DSC1\t", "DSC2\t") + "a b\n")
    said = problems(Maw(folder))
    assert "DSC2.png: no such file, expected a photograph" in said
    assert "line 3: has 1 columns, expected 6" in said
    meta.write_text(line + line)
    assert "scene_0_DSC1 occurs twice" in problems(Maw(folder))
    meta.write_text(line)
    np.save(folder / "labels/colors/DSC1.npy", np.ones((3, 3)))
    assert "has 2 labels beside 0, expected 3" in problems(Maw(folder))
    np.save(folder / "labels/colors/DSC1.npy", np.ones(3))
    assert "expected finite numbers of (k, 3)" in problems(Maw(folder))
    np.save(folder / "labels/colors/DSC1.npy", np.ones((2, 3)))
    mask = folder / "labels/colors/DSC1_mask.png"
    Image.open(mask).convert("RGB").save(mask)
    assert f"{mask}: got uint8 of (240, 320, 3), expected one channel of labels" in problems(Maw(folder))
    meta.unlink()
    assert "meta.csv: cannot be read" in problems(Maw(folder))


def test_pictures_shrink_by_area() -> None:
    checks = np.indices((8, 12)).sum(axis=0)[..., None] % 2 * np.ones(3)
    assert shrunk(checks.astype(np.float32), 6) == pytest.approx(np.full((4, 6, 3), 0.5))
    assert shrunk(checks.astype(np.float32), 12).shape == (8, 12, 3)


def test_an_error_of_a_thousand_lines_is_cut() -> None:
    error = PublicSetError("iiw", [f"line {i}" for i in range(1000)])
    assert len(str(error).splitlines()) == 42
    assert str(error).endswith("and 960 more")


def test_a_mask_without_an_object_is_refused(orb: StanfordOrb) -> None:
    path = orb.folder / "blender_LDR/cup_scene001/test_mask/0000.png"
    Image.fromarray(np.zeros((64, 64), np.uint8)).save(path)
    with pytest.raises(UnirenderError, match="shows no object"):
        orb.inputs(sample_of(orb, "cup_scene001_0000"))


def test_channels_of_radiance_are_read_as_they_are(orb: StanfordOrb) -> None:
    path = orb.folder / "blender_HDR/cup_scene002/test/0000.exr"
    write_exr(path, image_channels(np.full((64, 64, 3), np.float32(-1.0))))
    found = orb.score(
        sample_of(orb, "cup_scene001/relight_cup_scene002_0000"), Answer(image=np.zeros((32, 32, 3), np.float32)), ()
    )
    assert found[metric_key("relit", PSNR_L, Variant(scale="raw"))] == np.inf  # negative radiance is black


@pytest.mark.parametrize("reader", [StanfordOrb, Iiw, Maw])
def test_a_record_follows_all_that_its_set_is_read_and_scored_with(reader: type[PublicSet]) -> None:
    room = package_folder("unirender_evaluation")
    found, left = set(), [reader.__module__]
    while left:
        path = Path(*left.pop().split(".")[1:]).as_posix()
        if path in found or not path.startswith("public/"):
            continue
        found.add(path)
        for line in ast.walk(ast.parse((room / f"{path}.py").read_text(encoding="utf-8"))):
            if isinstance(line, ast.ImportFrom) and line.module:
                whole = line.module.endswith(".public")
                left += [f"{line.module}.{alias.name}" for alias in line.names] if whole else [line.module]
    assert len(found) > 2
    assert not [path for path in found if not any(fnmatch(path, pattern) for pattern in reader.modules)]
