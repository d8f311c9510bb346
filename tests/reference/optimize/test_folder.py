"""Folders of posed pictures: round trips, the dialects of transforms.json, and one sentence for each bad folder."""

import dataclasses
import json
import logging
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image
from posed_views import painted_view, painted_views, textured_object

from unirender.camera import Camera
from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender.exr import image_channels, write_exr
from unirender_reference.optimize.files.folder import read_views, write_views
from unirender_reference.optimize.files.state import fingerprint
from unirender_reference.optimize.multiview.config import OptimizeConfig
from unirender_reference.optimize.multiview.run import optimize
from unirender_reference.optimize.reduction import reduced
from unirender_reference.optimize.refine.losses import ImageLoss
from unirender_reference.optimize.shape.placement import placed
from unirender_reference.optimize.transport.config import MATRIX_BYTES, TransportConfig
from unirender_reference.optimize.views import View, Views
from unirender_reference.shapes import Sphere


def same_views(a: Views, b: Views, tolerance: float) -> None:
    assert (len(a.seen), len(a.held_out), a.hdr) == (len(b.seen), len(b.held_out), b.hdr)
    for one, other in zip((*a.seen, *a.held_out), (*b.seen, *b.held_out), strict=True):
        np.testing.assert_allclose(one.image, other.image, rtol=0, atol=tolerance)
        np.testing.assert_array_equal(one.mask, other.mask)
        np.testing.assert_array_equal(one.pose, other.pose)
        assert other.camera.fov_deg == pytest.approx(one.camera.fov_deg, abs=1e-9)
        assert other.camera.principal == pytest.approx(one.camera.principal, abs=1e-12)


def test_display_pictures_come_back_bit_for_bit(tmp_path: Path):
    views = painted_views()
    write_views(views, tmp_path / "set")
    same_views(views, read_views(tmp_path / "set"), 0.0)


def test_linear_pictures_come_back_to_rounding(tmp_path: Path):
    views = painted_views(hdr=True)
    write_views(views, tmp_path / "set")
    same_views(views, read_views(tmp_path / "set"), 2e-6)  # of values up to 4, premultiplied and divided again


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_views(painted_views(4, 0), tmp_path / "set")
    return tmp_path / "set"


def edited(folder: Path, change: Callable[[dict], object], name: str = "transforms.json") -> Path:
    path = folder / name
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    return folder


def test_angle_of_view_across_the_width_is_the_same_camera(folder: Path):
    views = read_views(folder)
    focal = 12 / (2 * math.tan(math.radians(18)))

    def as_angle(content: dict) -> None:
        content["camera_angle_x"] = 2 * math.atan(16 / (2 * focal))
        for frame in content["frames"]:
            for key in ("fl_x", "fl_y", "cx", "cy"):
                del frame[key]

    same_views(views, read_views(edited(folder, as_angle)), 0.0)


def test_focal_length_counts_in_pixels_of_the_stated_size(folder: Path, caplog: pytest.LogCaptureFixture):
    """Pictures at half the stated size (instant-ngp's images_2) have the same camera."""
    views = read_views(folder)

    def doubled(content: dict) -> None:
        content["w"], content["h"] = 32, 24
        for frame in content["frames"]:
            for key in ("fl_x", "fl_y", "cx", "cy"):
                frame[key] *= 2

    with caplog.at_level(logging.WARNING, "unirender"):
        same_views(views, read_views(folder), 0.0)
        assert not caplog.text
        same_views(views, read_views(edited(folder, doubled)), 0.0)
    assert (
        caplog.text.count("pictures are 16 x 12, w and h say 32 x 24: focal lengths and cx, cy are multiplied by 0.5")
        == 1
    )


def test_a_frame_with_an_angle_of_its_own_takes_no_focal_length_from_the_top(folder: Path):
    views = read_views(folder)

    def other_at_the_top(content: dict) -> None:
        content.update(fl_x=99.0, camera_angle_y=1.5)
        for frame in content["frames"]:
            focal = frame.pop("fl_x")
            del frame["fl_y"]
            frame["camera_angle_x"] = 2 * math.atan(16 / (2 * focal))

    same_views(views, read_views(edited(folder, other_at_the_top)), 0.0)


def test_a_focal_length_beside_its_angle_is_the_same_camera(folder: Path):
    """instant-ngp's converter writes both."""
    views = read_views(folder)

    def both(content: dict) -> None:
        for frame in content["frames"]:
            frame["camera_angle_x"] = 2 * math.atan(16 / (2 * frame["fl_x"]))

    same_views(views, read_views(edited(folder, both)), 0.0)


def test_what_nerfstudio_says_of_a_straight_lens_is_taken(folder: Path):
    views = read_views(folder)
    straight = {"camera_model": "pinhole", "distortion_params": [0, 0.0, 0, 0, 0, 0]}
    same_views(views, read_views(edited(folder, lambda content: content.update(straight))), 0.0)


def test_paths_with_the_backslashes_of_windows_are_found(folder: Path):
    views = read_views(folder)

    def of_windows(content: dict) -> None:
        for frame in content["frames"]:
            frame["file_path"] = frame["file_path"].replace("/", "\\")
            frame["mask_path"] = ".\\" + frame["file_path"]

    same_views(views, read_views(edited(folder, of_windows)), 0.0)


def test_cameras_far_from_the_worlds_origin_keep_their_places(folder: Path):
    """Places in metres of a national grid: float32 has steps of half a metre there."""
    place = Sphere(np.array([5e5, 4e6, 1e2]), 1.0)
    near = read_views(folder)

    def moved(content: dict) -> None:
        for frame in content["frames"]:
            for row, offset in zip(frame["transform_matrix"], place.center, strict=False):
                row[3] += offset

    far = placed(read_views(edited(folder, moved)), place)
    for given, found in zip(near.seen, far.seen, strict=True):
        np.testing.assert_allclose(found.pose, given.pose, rtol=0, atol=1e-6)


def test_pictures_without_suffix_in_the_layout_of_nerf_synthetic(folder: Path):
    def plain(content: dict) -> None:
        for frame in content["frames"]:
            frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")

    edited(folder, plain)
    (folder / "transforms.json").rename(folder / "transforms_train.json")
    shutil.copy(folder / "images/0000.png", folder / "images/other.png")
    one = json.loads((folder / "transforms_train.json").read_text())
    one["frames"] = [{**one["frames"][0], "file_path": "images/other"}]
    (folder / "transforms_val.json").write_text(json.dumps(one))
    views = read_views(folder)
    assert (len(views.seen), len(views.held_out)) == (4, 1)
    np.testing.assert_array_equal(views.held_out[0].image, views.seen[0].image)


def test_held_out_by_mark_and_by_number(folder: Path):
    edited(folder, lambda content: content["frames"][1].update(held_out=True))
    assert [view.name for view in read_views(folder).held_out] == ["images/0001.png"]
    views = read_views(folder, hold_out=3)
    assert [view.name for view in views.held_out] == ["images/0001.png", "images/0003.png"]
    assert [view.name for view in views.seen] == ["images/0000.png", "images/0002.png"]
    assert [view.name for view in read_views(folder, most_views=2).seen] == ["images/0000.png", "images/0002.png"]


def test_the_split_of_nerfstudio_is_kept(folder: Path):
    """What a split does not train on is not fitted; names compare as paths, and a frame's own word counts first."""
    names = [f"images/000{index}.png" for index in range(4)]

    def held_out() -> list[str]:
        return [view.name for view in read_views(folder).held_out]

    edited(folder, lambda content: content.update(val_filenames=["./" + names[2]], test_filenames=[names[3]]))
    assert held_out() == names[2:]
    edited(folder, lambda content: content.update(train_filenames=names[1:2]))
    assert held_out() == [names[0], *names[2:]]
    edited(folder, lambda content: content["frames"][2].update(held_out=False))
    assert held_out() == [names[0], names[3]]


def test_a_byte_order_mark_is_no_error(folder: Path):
    path = folder / "transforms.json"
    path.write_text(path.read_text(), encoding="utf-8-sig")
    assert len(read_views(folder).seen) == 4


def test_mask_files_stand_in_for_alpha(folder: Path):
    views = read_views(folder)
    for index, view in enumerate(views.seen):
        file = folder / f"images/{index:04d}.png"
        Image.open(file).convert("RGB").save(file)
        Image.fromarray(np.round(view.mask[..., 0] * 255).astype(np.uint8)).save(folder / f"mask{index}.png")

    def with_masks(content: dict) -> None:
        for index, frame in enumerate(content["frames"]):
            frame["mask_path"] = f"mask{index}.png"

    same_views(views, read_views(edited(folder, with_masks)), 0.0)


def test_z_up_turns_the_world_and_not_the_pictures(folder: Path):
    """A camera above a z-up world looks down from +y, and its right stays its right in the picture."""
    plain, turned = read_views(folder), read_views(folder, up="z")
    for one, other in zip(plain.seen, turned.seen, strict=True):
        x, y, z = one.pose[:3, 3]
        np.testing.assert_allclose(other.pose[:3, 3], [x, z, -y], atol=1e-6)
        np.testing.assert_array_equal(one.image, other.image)
    np.testing.assert_allclose(np.linalg.det(turned.seen[0].pose[:3, :3]), 1, atol=1e-5)


def test_reduced_pictures_keep_light_and_rays():
    """Light per solid angle of a constant disc, and where a point is seen, do not change."""
    view = painted_view(0, (60, 90))
    small = reduced(view, 30, linear=False)
    assert small.mask.shape == (20, 30, 1)
    light = (srgb_decode(view.image) * view.mask).mean()
    assert (srgb_decode(small.image) * small.mask).mean() == pytest.approx(light, rel=1e-4)
    odd = reduced(view, 32, linear=False)  # 90/32 does not divide 60: less than a pixel is cut off
    assert odd.mask.shape == (21, 31, 1)
    for other in (small, odd):
        pitch = math.tan(math.radians(other.camera.fov_deg) / 2) / other.mask.shape[0]
        wide = math.tan(math.radians(view.camera.fov_deg) / 2) / 60
        assert pitch / wide == pytest.approx(60 / (21 if other is odd else 20), rel=1e-6)
        np.testing.assert_allclose(other.camera.rays(*other.mask.shape[:2]).mean((0, 1))[:2], 0, atol=1e-6)
    twin = reduced(view, 30, linear=True)  # means of display values are another picture
    assert abs((srgb_decode(twin.image) * twin.mask).mean() / light - 1) > 0.05


def test_a_little_negative_radiance_is_zero_and_told(folder: Path, caplog: pytest.LogCaptureFixture):
    """As of every command that reads a picture: a filter's ringing is no reason to refuse it."""
    rgba = np.ones((12, 16, 4), np.float32)
    for index in range(4):
        rgba[5, 5, :3] = -0.1 * index
        write_exr(folder / f"images/{index}.exr", image_channels(rgba))
    edited(folder, lambda content: [f.update(file_path=f"images/{i}.exr") for i, f in enumerate(content["frames"])])
    with caplog.at_level(logging.WARNING, "unirender"):
        views = read_views(folder)
    assert views.seen[3].image[5, 5].max() == 0
    assert caplog.text.count("of the radiance is negative and was set to 0") == 3


def test_poses_count_in_the_pixels_as_they_are_stored(folder: Path, caplog: pytest.LogCaptureFixture):
    """As in COLMAP, nerfstudio and instant-ngp: a phone's note how it was held turns neither picture nor mask."""
    views = read_views(folder)
    for orientation in (3, 6):  # upside down; on its side, which has other proportions
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        for path in folder.glob("images/*.png"):
            Image.open(path).save(path, exif=exif)
        caplog.clear()
        with caplog.at_level(logging.WARNING, "unirender"):
            same_views(views, read_views(folder), 0.0)
        assert caplog.text.count("EXIF orientations of the pictures are not followed") == 1
    Image.new("L", (12, 16), 255).save(folder / "images/on_its_side.png")
    edited(folder, lambda content: content["frames"][0].update(mask_path="images/on_its_side.png"))
    with pytest.raises(UnirenderError, match=r"is 12 x 16 pixels, expected 16 x 12 like the picture$"):
        read_views(folder)


@pytest.mark.parametrize(
    "options", [{"hold_out": 1}, {"hold_out": -2}, {"most_views": 0}, {"longest_side": 0}], ids=lambda one: str(one)
)
def test_numbers_out_of_their_range_are_refused(folder: Path, options: dict[str, int]):
    (name,) = options
    with pytest.raises(UnirenderError, match=f"{name}: got .*, expected"):
        read_views(folder, **options)  # pyright: ignore[reportArgumentType] - a number each


def test_a_mean_with_a_clipped_value_is_a_lower_bound():
    """The reduced picture is far below 1 there, and says that it may be more."""
    image, mask = np.full((8, 8, 3), 0.5, np.float32), np.ones((8, 8, 1), np.float32)
    image[2, 2], image[4:6, 4:6], image[0, 7] = (1, 0.5, 0.5), 1, 1
    mask[0, 7] = 0
    small = reduced(View(image, mask, Camera(), np.eye(4), "one"), 4, linear=False)
    expected = np.zeros((4, 4, 3), bool)
    expected[1, 1, 0], expected[2, 2] = True, True
    assert small.image[1, 1, 0] < 0.75
    views = Views((small,))
    np.testing.assert_array_equal(views.saturated(small), expected)
    loss = ImageLoss(views)
    brighter = loss.target.copy()
    brighter[0, 1, 1, 0] += 0.2
    assert loss(brighter)[0] == 0
    brighter[0, 1, 1, 1] += 0.2
    assert loss(brighter)[0] > 0
    again = reduced(small, 2, linear=False)
    np.testing.assert_array_equal(Views((again,)).saturated(again), expected.reshape(2, 2, 2, 2, 3).any((1, 3)))
    assert fingerprint(views) != fingerprint(Views((dataclasses.replace(small, clipped=None),)))


def test_black_pictures_and_one_picture_twice_are_noticed(folder: Path, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.WARNING, "unirender"):
        read_views(folder)
        assert not caplog.text
        pixels = np.asarray(Image.open(folder / "images/0001.png")).copy()
        pixels[..., :3] = 0
        Image.fromarray(pixels).save(folder / "images/0001.png")
        shutil.copy(folder / "images/0000.png", folder / "images/0002.png")
        read_views(edited(folder, lambda content: content["frames"].append(content["frames"][3])))
    said = caplog.text
    assert "frames[1] (images/0001.png): the picture is black wherever its mask covers it; leave it out" in said
    assert "frames[2] (images/0002.png): the same picture as frames[0] (images/0000.png)" in said
    assert "frames[4] (images/0003.png): the same picture as frames[3] (images/0003.png)" in said


def broken(change: Callable[[dict], object]) -> Callable[[Path], object]:
    return lambda folder: edited(folder, change)


def first(**values: object) -> Callable[[Path], object]:
    return broken(lambda content: content["frames"][0].update(values))


def without(key: str) -> Callable[[Path], object]:
    return broken(lambda content: content["frames"][0].pop(key))


def cut(folder: Path) -> None:
    path = folder / "images/0000.png"
    path.write_bytes(path.read_bytes()[:60])


def opaque(folder: Path) -> None:
    Image.open(folder / "images/0000.png").convert("RGB").save(folder / "images/0000.png")


def empty_mask(folder: Path) -> None:
    image = np.zeros((12, 16, 4), np.uint8)
    Image.fromarray(image).save(folder / "images/0000.png")


def negative_exr(folder: Path) -> None:
    for index in range(4):
        write_exr(folder / f"images/{index}.exr", image_channels(np.full((12, 16, 4), -1.0 if index == 2 else 1.0)))
    edited(folder, lambda content: [f.update(file_path=f"images/{i}.exr") for i, f in enumerate(content["frames"])])


def mixed(folder: Path) -> None:
    write_exr(folder / "one.exr", image_channels(np.ones((12, 16, 4))))
    edited(folder, lambda content: content["frames"][0].update(file_path="one.exr"))


def two_kinds(folder: Path) -> None:
    shutil.copy(folder / "images/0000.png", folder / "images/0000.jpg")
    edited(folder, lambda content: content["frames"][0].update(file_path="images/0000"))


def other_size(folder: Path) -> None:
    Image.open(folder / "images/0000.png").resize((32, 24)).save(folder / "images/0000.png")


def all_black(folder: Path) -> None:
    for path in (folder / "images").iterdir():
        pixels = np.asarray(Image.open(path)).copy()
        pixels[..., :3] = 0
        Image.fromarray(pixels).save(path)


def seen_and_held_out(folder: Path) -> None:
    shutil.copy(folder / "transforms.json", folder / "transforms_test.json")


IDENTITY = np.eye(4).tolist()
BAD = {
    "no file": (lambda folder: (folder / "transforms.json").unlink(), "has no transforms.json"),
    "no JSON": (lambda folder: (folder / "transforms.json").write_text("{"), "not valid JSON"),
    "not UTF-8": (lambda folder: (folder / "transforms.json").write_bytes(b"\xff\xfe{"), "not valid JSON"),
    "deep": (lambda folder: (folder / "transforms.json").write_text("[" * 100_000), "transforms.json: not valid JSON"),
    "a list": (lambda folder: (folder / "transforms.json").write_text("[]"), "has no frames"),
    "no frames": (broken(lambda content: content.update(frames=[])), "has no frames"),
    "no path": (without("file_path"), r"frames\[0\] has no file_path"),
    "no picture": (first(file_path="gone"), "no picture .*gone"),
    "two pictures": (two_kinds, "may be 0000.png and 0000.jpg"),
    "no pose": (without("transform_matrix"), "transform_matrix is no 4 x 4 matrix"),
    "text as pose": (first(transform_matrix="left"), "transform_matrix is no 4 x 4 matrix"),
    "ragged pose": (first(transform_matrix=[[1, 0], [0]]), "transform_matrix is no 4 x 4 matrix"),
    "NaN pose": (first(transform_matrix=[[math.nan] * 4] * 4), "transform_matrix is no 4 x 4 matrix"),
    "transposed pose": (first(transform_matrix=(np.eye(4) + np.eye(4, k=-3)).tolist()), "last row 0 0 0 1"),
    "scaled pose": (first(transform_matrix=np.diag([2, 2, 2, 1]).tolist()), "without scale or mirroring"),
    "mirrored pose": (first(transform_matrix=np.diag([-1, 1, 1, 1]).tolist()), "without scale or mirroring"),
    "no lens": (
        broken(lambda c: [[f.pop(k) for k in ("fl_x", "fl_y")] for f in c["frames"]]),
        "no field of view, expected camera_angle_x or fl_x",
    ),
    "degrees": (
        broken(lambda c: [[f.pop(k) for k in ("fl_x", "fl_y")] for f in c["frames"]] and c.update(camera_angle_x=36)),
        "is it in degrees",
    ),
    "two angles": (
        broken(
            lambda c: (
                [[f.pop(k) for k in ("fl_x", "fl_y")] for f in c["frames"]],
                c.update(camera_angle_x=0.69, camera_angle_y=0.69),
            )
        ),
        r"focal lengths of 22\.\d+ and 16\.\d+ pixels in a picture of 16 x 12, expected one",
    ),
    "split as text": (broken(lambda c: c.update(test_filenames="images/0000.png")), "test_filenames is 'images/0000"),
    "focal 0": (first(fl_x=0, fl_y=0), "expected one positive focal length"),
    "endless focal": (first(fl_x=10**400), "fl_x is 1000.*, expected a finite number"),
    "endless pose": (first(transform_matrix=[[10**400] * 4] * 4), "transform_matrix is no 4 x 4 matrix"),
    "focal text": (first(fl_x="long"), "fl_x is 'long', expected a finite number"),
    "oblong pixels": (first(fl_x=40.0, fl_y=30.0), "square pixels"),
    "slightly oblong pixels": (first(fl_x=40.0, fl_y=39.8), "square pixels"),
    "focal length against angle": (
        first(camera_angle_x=1.2),
        r"focal length 18\.\d+ \(fl_x, fl_y\) and camera_angle_x, which makes it 11\.\d+ pixels in a picture of 16",
    ),
    "camera model": (first(camera_model="FISHEYE624"), r"expected a pinhole \(PINHOLE, "),
    "listed distortion": (first(distortion_params=[0.01, 0, 0, 0, 0, 0]), r"distorted \(distortion_params not 0\)"),
    "distortion": (first(k1=0.1), r"distorted \(k1 not 0\)"),
    "fisheye": (first(camera_model="OPENCV_FISHEYE"), "expected a pinhole"),
    "fisheye of instant-ngp": (broken(lambda content: content.update(is_fisheye=True)), "is_fisheye is true, expected"),
    "fisheye as text": (first(is_fisheye="false"), "is_fisheye is 'false', expected true or false"),
    "proportions": (broken(lambda content: content.update(w=100, h=100)), "expected the same proportions"),
    "held_out text": (first(held_out="yes"), "held_out is 'yes', expected true or false"),
    "all held out": (
        broken(lambda content: [frame.update(held_out=True) for frame in content["frames"]]),
        "all 4 pictures are held out",
    ),
    "seen and held out": (
        seen_and_held_out,
        r"transforms.json: frames\[0\] .* and .*transforms_test.json: frames\[0\] .* both seen and held out",
    ),
    "all black": (all_black, "all 4 pictures are black wherever their masks cover them"),
    "rows of a pose": (first(transform_matrix=np.eye(4)[:2].tolist()), "no 3 x 4 matrix without that row"),
    "no mask": (opaque, "has no alpha channel, and its frame no mask_path"),
    "empty mask": (empty_mask, "the mask is empty"),
    "mask missing": (first(mask_path="gone.png"), "gone.png: no such file"),
    "mask number": (first(mask_path=3), "mask_path is 3"),
    "cut picture": (cut, "not a readable picture"),
    "mixed kinds": (mixed, "has EXR beside other pictures"),
    "negative radiance": (negative_exr, "2.exr: 100% of the radiance is negative"),
    "other size": (other_size, r"16 x 12 \(images/0003.png\), 32 x 24 \(images/0000.png\), expected one size"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_folders_are_one_sentence(folder: Path, name: str):
    damage, message = BAD[name]
    damage(folder)
    with pytest.raises(UnirenderError, match=message) as caught:
        read_views(folder)
    assert "\n" not in str(caught.value)


def test_no_fisheye_is_a_pinhole(folder: Path):
    """As instant-ngp writes it of every other camera."""
    assert len(read_views(edited(folder, lambda content: content.update(is_fisheye=False))).seen) == 4


def test_missing_folder(tmp_path: Path):
    with pytest.raises(UnirenderError, match="is no folder"):
        read_views(tmp_path / "nowhere")


def test_more_pictures_than_fit_are_refused_before_they_are_read_or_worked_on(
    folder: Path, monkeypatch: pytest.MonkeyPatch
):
    """A run of them was killed by the system once the transport stage was over."""
    views = read_views(folder)
    count, pixels = len(views.seen) + len(views.held_out), views.height * views.width
    config = OptimizeConfig(TransportConfig(enabled=False), texture_size=4, light_rows=8)
    for bytes_of_pixel, does in ((15, lambda: read_views(folder)), (100, lambda: optimize(views, None, config))):
        monkeypatch.setattr("unirender.system.machine.memory_bytes", lambda most=bytes_of_pixel * count * pixels: most)
        with pytest.raises(UnirenderError, match=rf"^{count} pictures of .* pixels: would take .*--most-views, --size"):
            does()


def test_more_transport_than_fits_is_refused_before_the_work(folder: Path, monkeypatch: pytest.MonkeyPatch):
    """By the pixels that are asked for, or by all that are covered."""
    views = read_views(folder)
    covered = sum(int((view.mask > 0).sum()) for view in views.seen)
    small = OptimizeConfig(texture_size=4, light_rows=8)
    for pixels, taken in ((covered // 2, covered // 2), (10 * covered, covered)):
        config = dataclasses.replace(small, transport=TransportConfig(pixels=pixels))
        needed = MATRIX_BYTES * taken * 2 * 8**2
        monkeypatch.setattr("unirender.system.machine.memory_bytes", lambda needed=needed: needed)
        config.require_memory(covered)  # the twin
        monkeypatch.setattr("unirender.system.machine.memory_bytes", lambda needed=needed: needed - 1)
        with pytest.raises(UnirenderError, match=rf"^--transport.pixels {pixels}, --light-rows 8: would take about"):
            optimize(views, textured_object(), config)
